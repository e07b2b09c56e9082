//! What a scene would ask of the farm, as far as its inputs say without being read: procedural streams say how large they
//! are to be, microgrid streams below an asset root end with their counts. Other files tell nothing until they are imported.

use std::path::Path;

use engine::batch::RAYS_PER_BATCH_MAX;
use engine::scene::{BakeSet, Geometry, Instances, Scene, ShOcclusion, ShaderKind, StreamSource};
use engine::stream::ValueType;
use engine::stream::file::MgsReader;
use protocol::job::{BakeSettings, Estimate, SetEstimate};

/// What the bake sets of `scene` ask for. Files below `folder` are placeholders, which say nothing.
pub(super) fn sets(scene: &Scene, settings: &BakeSettings, folder: &Path) -> Vec<SetEstimate> {
    let mut estimates = Vec::new();
    for geometry in &scene.geometries {
        let points = points(geometry, folder);
        estimates.extend(geometry.bake_sets.iter().map(|set| estimate(scene, set, points, settings)));
    }
    estimates
}

/// The whole of it; `batch_ms` is what a batch took lately, where that is known.
pub(super) fn total(sets: Vec<SetEstimate>, input_bytes: u64, batch_ms: Option<f64>) -> Estimate {
    // A sum of which one part is not known is not known
    let sum = |of: fn(&SetEstimate) -> Option<u64>| sets.iter().map(of).sum::<Option<u64>>();
    let batches = sum(|set| set.batches);
    Estimate {
        input_bytes,
        points: sum(|set| set.points),
        batches,
        result_bytes: sum(|set| set.result_bytes),
        worker_seconds: batches.zip(batch_ms).map(|(batches, batch_ms)| batches as f64 * batch_ms / 1e3),
        sets,
    }
}

fn estimate(scene: &Scene, set: &BakeSet, points: Option<u64>, settings: &BakeSettings) -> SetEstimate {
    let shaders: Vec<&ShOcclusion> = set
        .attributes
        .iter()
        .filter_map(|attribute| {
            let shader = scene.shaders.iter().find(|shader| shader.name == attribute.shader)?;
            let ShaderKind::ShOcclusion(shader) = &shader.kind;
            Some(shader)
        })
        .collect();
    let rays = shaders.iter().map(|shader| settings.samples.unwrap_or(shader.samples)).max().unwrap_or(1);
    let batch_points = u64::from((RAYS_PER_BATCH_MAX / rays.max(1)).max(1));
    let point_bytes: u64 = shaders.iter().map(|shader| coefficient_bytes(shader)).sum();
    // Whole batches are baked, as many as the limit has room for
    let baked = match (points, settings.max_points) {
        (Some(points), Some(max)) if max < points => Some((max / batch_points).max(1) * batch_points),
        (points, _) => points,
    };
    SetEstimate {
        name: set.name.clone(),
        points: baked,
        batches: baked.map(|points| points.div_ceil(batch_points)),
        result_bytes: points.map(|points| points * point_bytes),
    }
}

/// Bytes that a shader adds to a point.
fn coefficient_bytes(shader: &ShOcclusion) -> u64 {
    let value_bytes = if shader.storage == ValueType::F16 { 2 } else { 4 };
    u64::from(shader.bands * shader.bands) * value_bytes
}

/// Points of a geometry, where its streams and copies say.
fn points(geometry: &Geometry, folder: &Path) -> Option<u64> {
    let streams: u64 =
        geometry.streams.iter().map(|source| stream_points(source, folder)).sum::<Option<u64>>()?;
    let copies = geometry.instances.iter().map(|instances| match instances {
        Instances::Matrix(_) => Some(1),
        Instances::File(_) => None,
    });
    let copies: u64 = copies.sum::<Option<u64>>()?;
    Some(streams * copies.max(1))
}

fn stream_points(source: &StreamSource, folder: &Path) -> Option<u64> {
    match source {
        // Patches of 15 x 15 quads have 16 x 16 points
        StreamSource::Procedural(procedural) => Some(procedural.micropolygons * 256 / 225),
        StreamSource::File(path, None) if !path.starts_with(folder) => {
            Some(MgsReader::open(path).ok()?.footer().ok()?.counts.vertices)
        }
        StreamSource::File(..) => None,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Catches an estimate that is not what the plan comes to, and a sum that leaves out what is not known.
    #[test]
    fn scenes_say_what_they_will_ask_for() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("scene.xml");
        let scene = r#"<scene version="1" units="m" up="y">
            <shaders> <shader name="s" type="sh_occlusion"> <param name="samples" value="1024"/> </shader> </shaders>
            <geometries>
              <geometry name="g" occluder="true"> <stream procedural="terrain" seed="7" micropolygons="225000"/>
                <bakeset name="g"> <attribute name="sh" shader="s"/> </bakeset> </geometry>
              <geometry name="f"> <stream file="f.obj"/> <bakeset name="f"> <attribute name="sh" shader="s"/> </bakeset> </geometry>
            </geometries>
        </scene>"#;
        std::fs::write(&path, scene).unwrap();
        std::fs::write(folder.path().join("f.obj"), "").unwrap();
        let scene = engine::scene::load(&path).unwrap();
        let found = sets(&scene, &BakeSettings::default(), folder.path());
        // 1,024 points fit into a batch; 9 coefficients of 4 bytes
        assert_eq!((found[0].points, found[0].batches), (Some(256_000), Some(250)));
        assert_eq!(found[0].result_bytes, Some(256_000 * 36));
        assert_eq!(
            found[1],
            SetEstimate { name: "f".into(), points: None, batches: None, result_bytes: None }
        );
        let known = total(found[..1].to_vec(), 5, Some(2_000.0));
        assert_eq!((known.batches, known.worker_seconds), (Some(250), Some(500.0)));
        let unknown = total(found, 5, Some(2_000.0));
        assert_eq!((unknown.batches, unknown.points, unknown.worker_seconds), (None, None, None));
        let settings = BakeSettings { max_points: Some(5_000), ..BakeSettings::default() };
        let few = sets(&scene, &settings, folder.path());
        assert_eq!((few[0].points, few[0].batches), (Some(4_096), Some(4)));
    }
}
