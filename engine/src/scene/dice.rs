//! How a stream is to be diced, as scenes and the command line write it: `world:SIZE`, `camera:NAME`, `camera:NAME:PIXELS`,
//! `texels:N`, or one of the former and the latter with a comma between.

use super::Camera;
use crate::error::nearest;
use crate::{Error, Result};

/// How fine to dice a stream.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Dice {
    /// How long edges may be; none keeps faces as they are, but for leaves.
    pub edge: Option<Edge>,
    /// How many texels long the edges of leaves may be, where they are cut along their texture; none is two.
    pub texels: Option<f64>,
}

/// How long edges may be.
#[derive(Clone, Debug, PartialEq)]
pub enum Edge {
    /// So many scene units, about.
    World(f64),
    /// So many pixels in the picture of a camera, about.
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
                "`{text}` is no way to dice, expected one of `world:SIZE`, `camera:NAME[:PIXELS]`, `texels:N`"
            ))
            .hint("a size is in scene units: `world:0.01`; leaves are cut along their texture: `world:0.01,texels:4`")
        };
        let positive =
            |text: &str| text.parse::<f64>().ok().filter(|x| *x > 0.0 && *x <= 1e12).ok_or_else(wrong);
        let mut dice = Self::default();
        for part in text.split(',') {
            let edge = match part.split_once(':').ok_or_else(wrong)? {
                ("world", size) => Edge::World(positive(size)?),
                ("camera", rest) => {
                    let (name, pixels) = rest.split_once(':').unwrap_or((rest, "1"));
                    if name.is_empty() {
                        return Err(wrong());
                    }
                    Edge::Camera { name: name.into(), pixels: positive(pixels)? }
                }
                ("texels", texels) if dice.texels.is_none() => {
                    dice.texels = Some(positive(texels)?.max(1.0));
                    continue;
                }
                _ => return Err(wrong()),
            };
            if dice.edge.replace(edge).is_some() {
                return Err(wrong());
            }
        }
        Ok(dice)
    }

    /// The camera that is meant, among those there are.
    ///
    /// # Errors
    /// [`ErrorKind::Invalid`](crate::ErrorKind::Invalid) for a camera that is not there.
    pub fn camera<'a>(&self, cameras: &'a [Camera]) -> Result<Option<&'a Camera>> {
        let Some(Edge::Camera { name, .. }) = &self.edge else { return Ok(None) };
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
        let dice = |edge, texels| Dice { edge, texels };
        assert_eq!(Dice::parse("world:0.25").unwrap(), dice(Some(Edge::World(0.25)), None));
        let camera = |pixels| dice(Some(Edge::Camera { name: "shot".into(), pixels }), None);
        assert_eq!(Dice::parse("camera:shot").unwrap(), camera(1.0));
        assert_eq!(Dice::parse("camera:shot:2.5").unwrap(), camera(2.5));
        assert_eq!(Dice::parse("texels:4").unwrap(), dice(None, Some(4.0)));
        assert_eq!(Dice::parse("world:2,texels:8").unwrap(), dice(Some(Edge::World(2.0)), Some(8.0)));
        let wrong = "|world|world:|world:0|world:-1|world:nan|camera:|camera:a:x|pixel:1|texels:|world:1,|world:1,camera:a";
        for text in wrong.split('|') {
            assert!(Dice::parse(text).is_err(), "{text}");
        }
        assert!(camera(1.0).camera(&[]).is_err());
        assert!(dice(Some(Edge::World(1.0)), None).camera(&[]).unwrap().is_none());
    }
}
