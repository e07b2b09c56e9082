//! `pantaray compare`: how far two streams of the same grids differ.

use std::path::PathBuf;

use clap::Args;
use engine::Result;
use engine::output::compare::compare;

use crate::console::{Answer, Console};
use crate::streams::{self, Watched};

/// Compare the attributes of two streams of the same grids
///
/// Per attribute and component: root mean square error, greatest difference and bias (mean of B - A); per band where
/// the components are spherical harmonics. Vertices that either stream has not baked are skipped.
#[derive(Debug, Args)]
pub struct Arguments {
    /// The stream to compare with, .mgs
    a: PathBuf,
    /// The stream to compare, .mgs
    b: PathBuf,
}

/// Compares.
pub fn run(arguments: Arguments, console: &Console) -> Result<Answer> {
    let mut a = Watched::new(streams::open(&arguments.a)?, "compare", console.control());
    let mut b = streams::open(&arguments.b)?;
    let comparison = compare(&mut a, &mut b).map_err(|error| error.at(&arguments.b))?;
    Answer::new(&comparison, comparison.to_string())
}
