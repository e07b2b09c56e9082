//! How a stream is to be diced, as scenes and the command line write it: `world:SIZE`, `camera:NAME`, `camera:NAME:PIXELS`.

use super::Camera;
use crate::error::nearest;
use crate::{Error, Result};

/// How fine to dice a stream.
#[derive(Clone, Debug, PartialEq)]
pub enum Dice {
    /// No edge longer than so many scene units, about.
    World(f64),
    /// No edge longer than so many pixels in the picture of a camera, about.
    Camera {
        /// The camera's name.
        name: String,
        /// Pixels.
        pixels: f64,
    },
}

impl Dice {
    /// Reads what a scene or the command line says.
    ///
    /// # Errors
    /// [`ErrorKind::Invalid`](crate::ErrorKind::Invalid) for anything else.
    pub fn parse(text: &str) -> Result<Self> {
        let wrong = || {
            Error::invalid(format!(
                "`{text}` says not how to dice, expected `world:SIZE` or `camera:NAME[:PIXELS]`"
            ))
            .hint("a size is in scene units: `world:0.01`")
        };
        let positive =
            |text: &str| text.parse::<f64>().ok().filter(|x| *x > 0.0 && *x <= 1e12).ok_or_else(wrong);
        match text.split_once(':').ok_or_else(wrong)? {
            ("world", size) => Ok(Self::World(positive(size)?)),
            ("camera", rest) => {
                let (name, pixels) = rest.split_once(':').unwrap_or((rest, "1"));
                if name.is_empty() {
                    return Err(wrong());
                }
                Ok(Self::Camera { name: name.into(), pixels: positive(pixels)? })
            }
            _ => Err(wrong()),
        }
    }

    /// The camera that is meant, among those there are.
    ///
    /// # Errors
    /// [`ErrorKind::Invalid`](crate::ErrorKind::Invalid) for a camera that is not there.
    pub fn camera<'a>(&self, cameras: &'a [Camera]) -> Result<Option<&'a Camera>> {
        let Self::Camera { name, .. } = self else { return Ok(None) };
        if let Some(found) = cameras.iter().find(|camera| camera.name == *name) {
            return Ok(Some(found));
        }
        let error = Error::invalid(format!("unknown camera `{name}` to dice by"));
        let near = nearest(name, cameras.iter().map(|camera| camera.name.as_str()));
        Err(near.map(|near| format!("did you mean `{near}`?")).into_iter().fold(error, Error::hint))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Catches a form that is misread, and nonsense that passes.
    #[test]
    fn what_is_written_is_understood() {
        assert_eq!(Dice::parse("world:0.25").unwrap(), Dice::World(0.25));
        let camera = |pixels| Dice::Camera { name: "shot".into(), pixels };
        assert_eq!(Dice::parse("camera:shot").unwrap(), camera(1.0));
        assert_eq!(Dice::parse("camera:shot:2.5").unwrap(), camera(2.5));
        for text in
            ["", "world", "world:", "world:0", "world:-1", "world:nan", "camera:", "camera:a:x", "pixel:1"]
        {
            assert!(Dice::parse(text).is_err(), "{text}");
        }
        assert!(camera(1.0).camera(&[]).is_err() && Dice::World(1.0).camera(&[]).unwrap().is_none());
    }
}
