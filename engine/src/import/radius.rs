//! The radius of points and lines that have none.

use super::ImportReport;
use super::cut::Clusters;
use super::mesh::Mesh;

/// Clusters that are measured at most, evenly spaced, and points in each: 2 M distances in all.
const CLUSTERS_MAX: usize = 256;
const POINTS_MAX: usize = 32;

/// The neighbour whose distance is the spacing: on a flat square lattice the four nearest stand one step away.
const NEIGHBOUR: usize = 4;

/// The radius for a mesh as a whole, by what there is more of: for points half their spacing, the median distance to
/// the fourth neighbour, at most a hundredth of the mesh's diagonal; a thousandth of the diagonal for lines; a
/// millimetre where the diagonal is zero.
///
/// Taken from neighbours, not from extent and count: clouds from photographs have far outliers and empty space.
pub(super) fn default_radius(mesh: &Mesh, clusters: &Clusters, meters_per_unit: f64) -> f32 {
    let count = |arity| mesh.faces.iter().filter(|face| face.arity == arity).count() as u64;
    let thin = [count(1), count(2)];
    choose(mesh.bounds().size().length(), thin, spacings(mesh, clusters), meters_per_unit)
}

/// The radius for so many points and lines in a box of this diagonal, by distances of points to their neighbours.
pub(super) fn choose(
    diagonal: f64,
    [points, lines]: [u64; 2],
    mut spacings: Vec<f64>,
    meters_per_unit: f64,
) -> f32 {
    let middle = spacings.len() / 2;
    let radius = match spacings.is_empty() {
        _ if lines > points => 0.001 * diagonal,
        true => 0.01 * diagonal,
        false => {
            let spacing = spacings.select_nth_unstable_by(middle, f64::total_cmp).1.sqrt();
            (0.5 * spacing).min(0.01 * diagonal)
        }
    };
    if radius > 0.0 { radius as f32 } else { (0.001 / meters_per_unit) as f32 }
}

/// Warns that points or lines of a mesh got a radius that nobody gave.
pub(super) fn warn_radius(mesh: &Mesh, radius: f32, report: &mut ImportReport) {
    if mesh.radii.is_empty() && mesh.has_radii() {
        warn(radius, report);
    }
}

/// Warns of a radius that nobody gave.
pub(super) fn warn(radius: f32, report: &mut ImportReport) {
    report.warn(format!("points or lines without a radius were given `{radius}`"));
}

/// The squared distances from points to their fourth neighbour in the same cluster; none where no cluster has five places.
pub(super) fn spacings(mesh: &Mesh, clusters: &Clusters) -> Vec<f64> {
    let step = clusters.iter().count().div_ceil(CLUSTERS_MAX).max(1);
    let (mut places, mut nearest, mut found) = (Vec::new(), Vec::new(), Vec::new());
    for cluster in clusters.iter().step_by(step) {
        places.clear();
        let points = cluster.iter().map(|&face| &mesh.faces[face as usize]).filter(|face| face.arity == 1);
        places.extend(points.map(|face| mesh.positions[mesh.face_corners(face)[0] as usize]));
        for &place in places.iter().step_by(places.len().div_ceil(POINTS_MAX).max(1)) {
            nearest.clear();
            nearest.extend(places.iter().map(|other| other.distance_squared(place)).filter(|&d| d > 0.0));
            if nearest.len() >= NEIGHBOUR {
                found.push(*nearest.select_nth_unstable_by(NEIGHBOUR - 1, f64::total_cmp).1);
            }
        }
    }
    found
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::import::cut;
    use crate::import::mesh::Face;
    use glam::DVec3;

    /// Points at the given places.
    fn cloud(places: impl Iterator<Item = DVec3>) -> Mesh {
        let mut mesh = Mesh::default();
        for place in places {
            let start = mesh.corners.len() as u32;
            mesh.faces.push(Face {
                start: start as _,
                arity: 1,
                material: 0,
                object: 0,
                opacity: 255,
                hole: false,
            });
            mesh.corners.push(mesh.positions.len() as u32);
            mesh.positions.push(place);
        }
        mesh
    }

    fn radius(mesh: &Mesh) -> f32 {
        default_radius(mesh, &cut::cut(mesh), 0.01)
    }

    /// Catches a radius that follows outliers, empty space or doubled points instead of the points' spacing.
    #[test]
    fn points_get_half_their_spacing_whatever_lies_far_away() {
        let sheet = || (0..10_000).map(|i| DVec3::new(f64::from(i % 100), f64::from(i / 100), 0.0) * 0.2);
        assert_eq!(radius(&cloud(sheet())), 0.1);
        assert_eq!(radius(&cloud(sheet().chain(sheet()))), 0.1);
        let outliers = (0..50).map(|i| DVec3::new(1000.0, f64::from(i * i), f64::from(i)));
        assert_eq!(radius(&cloud(sheet().chain(outliers))), 0.1);
    }

    /// Catches clouds too small to have a spacing that get a radius of zero, or one as large as they are.
    #[test]
    fn few_points_get_a_share_of_their_extent() {
        let two = cloud([DVec3::ZERO, DVec3::new(0.0, 0.0, 3.0)].into_iter());
        assert_eq!(radius(&two), 0.03);
        let one = cloud([DVec3::ONE].into_iter());
        assert_eq!(radius(&one), 0.1, "a millimetre, in centimetres");
    }
}
