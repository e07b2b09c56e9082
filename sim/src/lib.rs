//! A farm that is not there: real coordinators in processes of their own, on a real database, and seeded fake workers that
//! speak to them over real HTTP with the real worker's client. Fake workers sleep where real ones bake; nothing else is
//! pretended, and nobody but the coordinators writes to the database.
//!
//! [`stage`] sets up coordinators, database and tokens; [`crew`] and [`fake`] are the workers; [`load`] says what jobs
//! cost and where they fail; [`ledger`] remembers what the workers were told, and holds it against the database afterwards;
//! [`scenario`] names what is tried, and what must come of it. The idea is that of OpenCue's `maestro-sim`.

pub mod crew;
pub mod fake;
pub mod ledger;
pub mod load;
pub mod process;
pub mod random;
pub mod report;
pub mod scenario;
pub mod stage;
pub mod wire;

pub use engine::{Error, Result};
