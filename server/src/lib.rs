//! The coordinator: submissions, queue and leases over HTTP. Not built yet.
