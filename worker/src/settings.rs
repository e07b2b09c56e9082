//! A job's settings as the engine's options.

use engine::bake::BakeOptions;
use engine::cut::Lod;
use engine::{Error, Result};
use protocol::job::BakeSettings;

/// The options of a bake with `settings` on a machine whose resources `machine` says.
///
/// # Errors
/// [`engine::ErrorKind::Invalid`] for a word that the engine does not understand.
pub fn options(settings: &BakeSettings, machine: &BakeOptions) -> Result<BakeOptions> {
    let lod = settings.lod.as_deref().map(Lod::parse).transpose()?;
    let far_field = settings.far_field.as_deref().map(str::parse).transpose().map_err(Error::invalid)?;
    Ok(BakeOptions {
        lod: lod.unwrap_or(machine.lod),
        far_field: far_field.unwrap_or(machine.far_field),
        seed: settings.seed,
        samples: settings.samples,
        points_max: settings.max_points,
        ..machine.clone()
    })
}
