//! Card trees beside their own pictures: what a tree becomes when it is cut along its texture, and the tree as its file has
//! it, texture and all, are drawn from the same place and must look the same.
//!
//! The file is read here by other code than the engine's, and its alpha is looked up texel by texel.

use std::path::Path;

use glam::{DMat4, DVec2, DVec3};
use serde_json::Value;

use crate::import::assets::folder;
use crate::import::{ImportOptions, import_parts};
use crate::stream::{Microgrid, MicrogridStream};

/// Pixels of a picture along each axis.
const PIXELS: usize = 480;

/// A picture of how much light does not pass, looked at along an axis.
struct Picture {
    /// The share of the light that passes each pixel.
    passing: Vec<f64>,
    low: DVec2,
    size: f64,
    axis: usize,
}

impl Picture {
    fn new((low, high): (DVec3, DVec3), axis: usize) -> Self {
        let (low, high) = (flat(low, axis), flat(high, axis));
        Self { passing: vec![1.0; PIXELS * PIXELS], low, size: (high - low).max_element() * 1.001, axis }
    }

    /// Draws a triangle; `opacity` gives its opacity at barycentric coordinates.
    fn draw(&mut self, corners: [DVec3; 3], opacity: impl Fn([f64; 3]) -> f64) {
        let p = corners.map(|corner| (flat(corner, self.axis) - self.low) * (PIXELS as f64 / self.size));
        let area = (p[1] - p[0]).perp_dot(p[2] - p[0]);
        if area == 0.0 {
            return;
        }
        let (low, high) = (p[0].min(p[1]).min(p[2]), p[0].max(p[1]).max(p[2]));
        let range = |a: f64, b: f64| (a.floor().max(0.0) as usize)..(b.ceil() as usize).min(PIXELS);
        for y in range(low.y, high.y) {
            for x in range(low.x, high.x) {
                let at = DVec2::new(x as f64 + 0.5137, y as f64 + 0.4871);
                let share = |i: usize| (p[(i + 1) % 3] - at).perp_dot(p[(i + 2) % 3] - at) / area;
                let shares = [0, 1, 2].map(share);
                if shares.iter().all(|share| *share >= 0.0) {
                    self.passing[y * PIXELS + x] *= 1.0 - opacity(shares);
                }
            }
        }
    }

    /// What is covered, on average over blocks of `edge` by `edge` pixels.
    fn blocks(&self, edge: usize) -> Vec<f64> {
        let count = PIXELS / edge;
        let mut sums = vec![0.0; count * count];
        for (i, passing) in self.passing.iter().enumerate() {
            sums[i / PIXELS / edge * count + i % PIXELS / edge] += (1.0 - passing) / (edge * edge) as f64;
        }
        sums
    }
}

fn flat(p: DVec3, axis: usize) -> DVec2 {
    if axis == 2 { p.truncate() } else { DVec2::new(p.z, p.y) }
}

/// A triangle of a file: corners, texture coordinates, and the number of its material.
struct Triangle {
    corners: [DVec3; 3],
    uv: [DVec2; 3],
    material: usize,
}

/// A glTF file as its document says.
struct Document {
    json: Value,
    bytes: Vec<u8>,
    folder: std::path::PathBuf,
}

impl Document {
    fn open(path: &Path) -> Self {
        let file = std::fs::read(path).unwrap();
        let folder = path.parent().unwrap().to_path_buf();
        if !file.starts_with(b"glTF") {
            let json: Value = serde_json::from_slice(&file).unwrap();
            let bytes = std::fs::read(folder.join(json["buffers"][0]["uri"].as_str().unwrap())).unwrap();
            return Self { json, bytes, folder };
        }
        let length = u32::from_le_bytes(file[12..16].try_into().unwrap()) as usize;
        let json = serde_json::from_slice(&file[20..20 + length]).unwrap();
        Self { json, bytes: file[28 + length..].to_vec(), folder }
    }

    fn view(&self, view: &Value) -> &[u8] {
        let start = view["byteOffset"].as_u64().unwrap_or(0) as usize;
        &self.bytes[start..start + view["byteLength"].as_u64().unwrap() as usize]
    }

    /// Numbers of an accessor without gaps: floats, or unsigned integers of 16 or 32 bits.
    fn numbers(&self, accessor: &Value) -> Vec<f64> {
        let accessor = &self.json["accessors"][accessor.as_u64().unwrap() as usize];
        let width = match accessor["type"].as_str().unwrap() {
            "VEC3" => 3,
            "VEC2" => 2,
            _ => 1,
        };
        let bytes = self.view(&self.json["bufferViews"][accessor["bufferView"].as_u64().unwrap() as usize]);
        let bytes = &bytes[accessor["byteOffset"].as_u64().unwrap_or(0) as usize..];
        let count = accessor["count"].as_u64().unwrap() as usize * width;
        let four = |b: &[u8]| <[u8; 4]>::try_from(b).unwrap();
        match accessor["componentType"].as_u64().unwrap() {
            5123 => {
                bytes.chunks(2).take(count).map(|b| f64::from(u16::from_le_bytes([b[0], b[1]]))).collect()
            }
            5125 => bytes.chunks(4).take(count).map(|b| f64::from(u32::from_le_bytes(four(b)))).collect(),
            _ => bytes.chunks(4).take(count).map(|b| f64::from(f32::from_le_bytes(four(b)))).collect(),
        }
    }

    /// All triangles of the document's first scene, in the world.
    fn triangles(&self) -> Vec<Triangle> {
        let mut all = Vec::new();
        let mut nodes: Vec<(u64, DMat4)> = Vec::new();
        let push = |nodes: &mut Vec<(u64, DMat4)>, list: &Value, matrix: DMat4| {
            nodes.extend(list.as_array().into_iter().flatten().map(|node| (node.as_u64().unwrap(), matrix)));
        };
        match self.json["scenes"].as_array() {
            Some(scenes) => push(&mut nodes, &scenes[0]["nodes"], DMat4::IDENTITY),
            None => nodes.extend(
                (0..self.json["nodes"].as_array().unwrap().len() as u64).map(|n| (n, DMat4::IDENTITY)),
            ),
        }
        while let Some((node, parent)) = nodes.pop() {
            let node = &self.json["nodes"][node as usize];
            let matrix = node["matrix"].as_array().map_or(DMat4::IDENTITY, |numbers| {
                DMat4::from_cols_array(&std::array::from_fn(|i| numbers[i].as_f64().unwrap()))
            });
            let matrix = parent * matrix;
            push(&mut nodes, &node["children"], matrix);
            if let Some(mesh) = node["mesh"].as_u64() {
                self.add_mesh(&self.json["meshes"][mesh as usize], matrix, &mut all);
            }
        }
        all
    }

    fn add_mesh(&self, mesh: &Value, matrix: DMat4, all: &mut Vec<Triangle>) {
        for primitive in mesh["primitives"].as_array().unwrap() {
            let positions = self.numbers(&primitive["attributes"]["POSITION"]);
            let uvs = self.numbers(&primitive["attributes"]["TEXCOORD_0"]);
            let material = primitive["material"].as_u64().unwrap() as usize;
            for face in self.numbers(&primitive["indices"]).chunks(3) {
                let face = [0, 1, 2].map(|i| face[i] as usize);
                let corners = face.map(|i| matrix.transform_point3(DVec3::from_slice(&positions[3 * i..])));
                let uv = face.map(|i| DVec2::from_slice(&uvs[2 * i..]));
                all.push(Triangle { corners, uv, material });
            }
        }
    }

    /// The alpha of each material: its picture if it has one that counts, and its cut-off if it is a mask.
    fn alphas(&self) -> Vec<(Option<image::RgbaImage>, Option<f64>)> {
        let of = |material: &Value| {
            let mode = material["alphaMode"].as_str().unwrap_or("OPAQUE");
            let texture = material["pbrMetallicRoughness"]["baseColorTexture"]["index"].as_u64();
            let texture = texture.filter(|_| mode != "OPAQUE");
            let picture = texture.map(|texture| {
                let source = self.json["textures"][texture as usize]["source"].as_u64().unwrap();
                let image = &self.json["images"][source as usize];
                let bytes = match image["bufferView"].as_u64() {
                    Some(view) => self.view(&self.json["bufferViews"][view as usize]).to_vec(),
                    None => std::fs::read(self.folder.join(image["uri"].as_str().unwrap())).unwrap(),
                };
                image::load_from_memory(&bytes).unwrap().to_rgba8()
            });
            let cutoff = (mode == "MASK").then(|| material["alphaCutoff"].as_f64().unwrap_or(0.5));
            (picture, cutoff)
        };
        self.json["materials"].as_array().unwrap().iter().map(of).collect()
    }
}

/// Draws the file as it is.
fn draw_file(document: &Document, picture: &mut Picture) {
    let alphas = document.alphas();
    for Triangle { corners, uv, material } in document.triangles() {
        let (image, cutoff) = &alphas[material];
        picture.draw(corners, |shares| {
            let Some(image) = image else { return 1.0 };
            let at = uv.iter().zip(shares).map(|(uv, share)| *uv * share).sum::<DVec2>();
            let texel = |x: f64, size: u32| ((x.rem_euclid(1.0) * f64::from(size)) as u32).min(size - 1);
            let alpha = image.get_pixel(texel(at.x, image.width()), texel(at.y, image.height()))[3];
            let alpha = f64::from(alpha) / 255.0;
            cutoff.map_or(alpha, |cutoff| if alpha >= cutoff { 1.0 } else { 0.0 })
        });
    }
}

/// Draws what the file became.
fn draw_stream(stream: &mut dyn MicrogridStream, picture: &mut Picture) {
    let schema = stream.schema().clone();
    let column = schema.find("opacity").unwrap();
    let mut grid = Microgrid::default();
    while stream.next(&mut grid).unwrap() {
        for face in grid.faces() {
            let opacity = f64::from(grid.unit_value(&schema, column, usize::from(face[0]), 0));
            for i in 2..face.len() {
                let corners =
                    [face[0], face[i - 1], face[i]].map(|vertex| grid.position(usize::from(vertex)));
                picture.draw(corners, |_| opacity);
            }
        }
    }
}

/// Catches a tree that is denser or thinner than its texture makes it, or has another outline, from the front or the side:
/// one whose cut-off is not heeded, whose leaves are cards, shifted or mirrored on them, and cards that are lost.
#[test]
fn card_trees_look_like_their_textures() {
    let Some(assets) = folder() else { return };
    for (name, alike) in [("trees_eztree/aspen_small.glb", 0.9), ("pine_gltf/scene.gltf", 0.85)] {
        let path = assets.join(name);
        let document = Document::open(&path);
        let corners =
            || document.triangles().into_iter().flat_map(|triangle| triangle.corners).collect::<Vec<_>>();
        let low = corners().into_iter().fold(DVec3::INFINITY, DVec3::min);
        let high = corners().into_iter().fold(DVec3::NEG_INFINITY, DVec3::max);
        let folder = tempfile::tempdir().unwrap();
        let options = ImportOptions { texels: Some(16.0), ..ImportOptions::default() };
        let (parts, report) =
            import_parts(&path, &folder.path().join("tree.mgs"), &options, &mut |_| Ok(())).unwrap();
        assert!(
            report.skipped.iter().any(|(reason, count)| reason.contains("wholly clear") && *count > 1000)
        );
        for axis in [0, 2] {
            let [mut file, mut tree] = [(); 2].map(|()| Picture::new((low, high), axis));
            draw_file(&document, &mut file);
            draw_stream(&mut *parts.open().unwrap(), &mut tree);
            let mean = |values: &[f64]| values.iter().sum::<f64>() / values.len() as f64;
            let [file_mean, tree_mean] = [&file, &tree].map(|picture| mean(&picture.blocks(1)));
            let pairs: Vec<[bool; 2]> =
                file.passing.iter().zip(&tree.passing).map(|(a, b)| [*a < 0.5, *b < 0.5]).collect();
            let both = pairs.iter().filter(|pair| pair[0] && pair[1]).count() as f64;
            let either = pairs.iter().filter(|pair| pair[0] || pair[1]).count() as f64;
            let squares =
                file.blocks(8).iter().zip(tree.blocks(8)).map(|(a, b)| (a - b).powi(2)).collect::<Vec<_>>();
            let rmse = mean(&squares).sqrt();
            eprintln!(
                "{name} along axis {axis}: covered {file_mean:.4} and {tree_mean:.4}, outlines share {:.3}, rmse of blocks {rmse:.4}",
                both / either
            );
            assert!((tree_mean / file_mean - 1.0).abs() < 0.02, "{name}: {file_mean} {tree_mean}");
            assert!(both / either > alike, "{name}: {}", both / either);
            assert!(rmse < 0.02, "{name}: {rmse}");
        }
    }
}
