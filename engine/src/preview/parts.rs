//! The preview of a bake that is under way: the points of finished batches, as the plan has them, with what their parts
//! hold. There is no stream to read yet, so there is no albedo.

use std::path::Path;

use glam::{DVec3, Vec3};

use super::file::{self, Header};
use super::sample::{Points, hash};
use super::{find_error, tree};
use crate::batch::Point;
use crate::output::{Part, PartFormat, PartHeader};
use crate::relight::draw::ALBEDO_DEFAULT;
use crate::relight::find_attribute;
use crate::scene::{Domain, UpAxis, Weight};
use crate::stream::{Attribute, Schema, ValueType};
use crate::{Error, ErrorKind, Result};

/// What the scene says about a bake set's coefficients.
#[derive(Clone, Debug, PartialEq)]
pub struct Setting {
    /// The attribute of the coefficients, where the scene says which.
    pub attribute: Option<String>,
    /// How directions weigh.
    pub weight: Weight,
    /// Where rays go.
    pub domain: Domain,
    /// Metres per scene unit.
    pub meters_per_unit: f64,
    /// Which way is up.
    pub up: UpAxis,
}

/// A preview in the making; holds the points that it was given.
#[derive(Debug)]
pub struct PartsPreview {
    setting: Setting,
    points_per_batch_max: u32,
    /// What the first part said about all of them.
    known: Option<(PartFormat, Header)>,
    points: Points,
    part: Part,
}

impl PartsPreview {
    /// An empty preview of a plan whose batches have at most so many points.
    pub fn new(setting: Setting, points_per_batch_max: u32) -> Self {
        let (known, points, part) = Default::default();
        Self { setting, points_per_batch_max, known, points, part }
    }

    /// Points so far.
    pub fn len(&self) -> usize {
        self.points.positions.len()
    }

    /// Whether there are none.
    pub fn is_empty(&self) -> bool {
        self.points.positions.is_empty()
    }

    /// Adds a finished batch: the encoded part, and its points as the plan has them.
    ///
    /// # Errors
    /// [`ErrorKind::Corrupt`] when the part is damaged, or of other points; [`ErrorKind::Invalid`] when it is of another
    /// bake; [`ErrorKind::NotFound`] when parts hold no coefficients. Nothing is added then.
    pub fn add(&mut self, bytes: &[u8], path: &Path, planned: &[Point]) -> Result<()> {
        if self.known.is_none() {
            self.known = Some(self.look_at(&PartHeader::decode(bytes, path, 0)?)?);
            self.points.corner = planned.first().map_or(DVec3::ZERO, |point| point.position);
        }
        let Some((format, header)) = &self.known else { return Ok(()) };
        self.part.decode(bytes, format, path, 0)?;
        self.part.check(format)?;
        // Rows stand by rising index, the plan's points along a curve
        let row = |point: &Point| self.part.indices.binary_search(&point.index).ok();
        if planned.len() != self.part.indices.len() || planned.iter().any(|point| row(point).is_none()) {
            return Err(Error::new(ErrorKind::Corrupt, "a part of other points than the plan has").at(path));
        }
        let (column, error) = header.columns;
        let places = [Some(column), error].map(|column| column.map(|column| place(format, column)));
        for point in planned {
            let Some(row) = row(point).filter(|&row| self.part.covered.contains(row as u64)) else {
                continue;
            };
            let row = self.part.row(format, row);
            let numbers = places.iter().flatten().flat_map(|(at, attribute)| numbers(&row[*at..], attribute));
            self.points.positions.push((point.position - self.points.corner).as_vec3());
            self.points.hashes.push(hash(point.index));
            self.points.push_record(header, point.normal, Vec3::splat(ALBEDO_DEFAULT), numbers);
        }
        Ok(())
    }

    /// What the parts' attributes say.
    fn look_at(&self, part: &PartHeader) -> Result<(PartFormat, Header)> {
        let Setting { attribute, weight, domain, meters_per_unit, up } = &self.setting;
        let format = PartFormat::new(part.bake, &part.attributes, self.points_per_batch_max)?;
        let attributes = part.attributes.clone();
        let schema = Schema { meters_per_unit: *meters_per_unit, up: *up, attributes };
        let column = find_attribute(&schema, attribute.as_deref())?;
        let error = find_error(&schema, &schema.attributes[column].name);
        let mut header = Header::new(&schema, (column, error), *weight, Some(*domain));
        // The plan has them, not the parts
        header.has[0] = true;
        Ok((format, header))
    }

    /// The preview's bytes; none without points. `baked` is how many points have a result, of which these are a sample.
    pub fn encode(self, baked: u64) -> Option<Vec<u8>> {
        let (_, mut header) = self.known.filter(|_| !self.points.positions.is_empty())?;
        header.baked = baked.max(self.points.positions.len() as u64);
        let nodes = tree::spread(&self.points, &mut header);
        Some(file::encode(&header, &nodes, &self.points))
    }
}

/// Where in a row an attribute begins, and the attribute.
fn place(format: &PartFormat, column: usize) -> (usize, &Attribute) {
    let before = format.attributes()[..column].iter().map(Attribute::value_bytes).sum();
    (before, &format.attributes()[column])
}

/// The numbers of an attribute, which stand at the beginning of `bytes`.
fn numbers<'a>(bytes: &'a [u8], attribute: &'a Attribute) -> impl Iterator<Item = f32> + 'a {
    let values = bytes.chunks_exact(attribute.value_type.bytes()).take(usize::from(attribute.components));
    values.map(|value| match attribute.value_type {
        ValueType::F16 => half::f16::from_le_bytes([value[0], value[1]]).to_f32(),
        ValueType::F32 => f32::from_le_bytes([value[0], value[1], value[2], value[3]]),
        ValueType::U32 => u32::from_le_bytes([value[0], value[1], value[2], value[3]]) as f32,
        ValueType::U8 => f32::from(value[0]),
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn points(indices: [u64; 3]) -> Vec<Point> {
        let point = |index| Point { index, position: DVec3::new(index as f64, 0.0, 0.0), normal: Vec3::Y };
        indices.map(point).into()
    }

    /// Catches rows that go to other points, points without a result that are shown as dark ones, and parts that are damaged
    /// or of other points and are believed.
    #[test]
    fn rows_belong_to_their_points() {
        let attributes =
            [Attribute::vertex("sh", ValueType::F32, 4), Attribute::vertex("sh_error", ValueType::F16, 1)];
        let format = PartFormat::new(7, &attributes, 8).unwrap();
        // Along a curve, not by index; the last has no result
        let planned = points([5, 1, 9]);
        let mut part = Part::default();
        part.start(0, planned.iter().map(|point| point.index), &format);
        for (row, point) in planned.iter().take(2).enumerate() {
            part.set_row(&format, row, &[point.index as f32, 0.0, 0.0, 0.0, 0.5 * point.index as f32]);
        }
        let mut bytes = Vec::new();
        part.encode(&format, &mut bytes).unwrap();

        let (weight, domain, up) = (Weight::Uniform, Domain::Hemisphere, UpAxis::Y);
        let setting = Setting { attribute: Some("sh".into()), weight, domain, meters_per_unit: 1.0, up };
        let mut preview = PartsPreview::new(setting, 8);
        let path = Path::new("part");
        preview.add(&bytes, path, &planned).unwrap();
        let number = |bytes: &[u8]| half::f16::from_le_bytes([bytes[0], bytes[1]]).to_f32();
        let found: Vec<_> = preview
            .points
            .records
            .chunks_exact(18)
            .zip(&preview.points.positions)
            .map(|(record, position)| (position.x, number(&record[8..]), number(&record[16..])))
            .collect();
        assert_eq!(found, [(0.0, 5.0, 2.5), (-4.0, 1.0, 0.5)]);

        let other = preview.add(&bytes, path, &points([5, 1, 8])).unwrap_err();
        assert_eq!(other.kind(), ErrorKind::Corrupt);
        assert!(preview.add(&bytes, path, &planned[..2]).is_err());
        bytes[50] ^= 1;
        assert_eq!(preview.add(&bytes, path, &planned).unwrap_err().kind(), ErrorKind::Corrupt);
        assert_eq!(preview.len(), 2);
        assert!(preview.encode(3).is_some());
    }
}
