//! What a bake reports: `report.json`, field by field as documented in `docs/report.md`.
