//! Faces that a material lets light through: their opacity, averaged over each, or the leaves that are cut along a texture.

use glam::{DVec3, Vec2};

use super::material::Cover;
use crate::Result;
use crate::import::emit::opacity_byte;
use crate::import::leaves::texture::{AlphaMode, Averager, Texture, coverage};
use crate::import::mesh::{Extra, Face, Mesh};
use crate::import::{ImportReport, polygon};
use crate::stream::Attribute;

/// Faces to be cut along a texture.
pub(super) struct Leaf {
    /// Triangles.
    pub mesh: Mesh,
    pub texture: Texture,
    pub alpha: AlphaMode,
    pub opacity: f32,
    /// Which of the mesh's further attributes has the coordinates.
    uv: usize,
}

impl Leaf {
    /// Texture coordinates and alpha of a corner.
    pub fn corner(&self, corner: usize) -> (Vec2, f32) {
        (uv_at(&self.mesh, &self.mesh.extras[self.uv], corner), 1.0)
    }
}

/// Gives faces the opacity of their covers, and takes those out that are to be `cut`. Faces name their cover by their
/// material, from 1.
pub(super) fn apply(
    mesh: &mut Mesh,
    covers: Vec<Cover>,
    attributes: &[Attribute],
    cut: bool,
    report: &mut ImportReport,
) -> Result<Vec<Leaf>> {
    if covers.is_empty() {
        return Ok(Vec::new());
    }
    // What is displayed where there is no material
    mesh.opacities.clear();
    mesh.variant_opacities.clear();
    let mut leaves = Vec::new();
    for (number, cover) in covers.into_iter().enumerate() {
        let is_own = |face: &Face| face.material == number as u32 + 1;
        let found = cover.texture.and_then(|(texture, name)| {
            let uv = attributes.iter().position(|attribute| attribute.name == name);
            let uv = uv
                .filter(|&uv| mesh.extras.get(uv).is_some_and(|e| e.components >= 2 && !e.values.is_empty()));
            if uv.is_none() {
                report.warn(format!(
                    "textures are looked up with `{name}`, which a mesh does not have: it is opaque"
                ));
            }
            Some((texture, uv?))
        });
        match found {
            Some((texture, uv)) if cut => {
                let (own, rest): (Vec<Face>, Vec<Face>) = mesh.faces.iter().copied().partition(is_own);
                let mut part = Mesh { faces: own, subdivision: None, ..mesh.clone() };
                mesh.faces = rest;
                part.finish(report)?;
                part.split_quads();
                leaves.push(Leaf { mesh: part, texture, alpha: cover.alpha, opacity: cover.opacity, uv });
            }
            Some((texture, uv)) => {
                let averager = Averager::new(&texture, cover.alpha, cover.opacity, mesh.faces.len());
                let mut faces = std::mem::take(&mut mesh.faces);
                for face in faces.iter_mut().filter(|face| is_own(face)) {
                    face.opacity = opacity_byte(average(mesh, face, &averager, &mesh.extras[uv]));
                }
                mesh.faces = faces;
            }
            None => {
                let opacity = opacity_byte(coverage(cover.alpha, cover.opacity));
                mesh.faces.iter_mut().filter(|face| is_own(face)).for_each(|face| face.opacity = opacity);
            }
        }
    }
    // What is wholly clear shapes the surface of a cage all the same
    let is_clear = |face: &Face| face.material != 0 && face.opacity == 0 && !face.hole;
    report
        .skip("faces that are wholly clear", mesh.faces.iter().filter(|face| is_clear(face)).count() as u64);
    mesh.faces.iter_mut().filter(|face| is_clear(face)).for_each(|face| face.hole = true);
    if mesh.subdivision.is_none() {
        mesh.open_holes();
    }
    Ok(leaves)
}

/// The opacity of a face: the mean of the triangles of its fan, weighted by area.
fn average(mesh: &Mesh, face: &Face, averager: &Averager<'_>, uv: &Extra) -> f32 {
    let (mut sum, mut weight) = (0.0, 0.0);
    let start = face.start as usize;
    for i in 1..face.arity.max(2) as usize - 1 {
        let corners = [start, start + i, start + i + 1];
        let points = corners.map(|corner| mesh.positions[mesh.corners[corner] as usize]);
        let area = polygon::area_normal(&points).length().clamp(1e-30, 1e30) as f32;
        let average = averager.sample(corners.map(|corner| uv_at(mesh, uv, corner)), [1.0; 3]);
        sum += area * average.opacity;
        weight += area;
    }
    if weight > 0.0 { sum / weight } else { 1.0 }
}

/// The first two numbers of an attribute at a corner.
fn uv_at(mesh: &Mesh, uv: &Extra, corner: usize) -> Vec2 {
    let value = uv.at(mesh.corners[corner] as usize, mesh.variant(corner));
    value.map_or(Vec2::ZERO, Vec2::from_slice)
}

/// The centre of a mesh's faces and those of its leaves.
pub(super) fn center(mesh: &Mesh, leaves: &[Leaf]) -> DVec3 {
    let parts = leaves.iter().map(|leaf| leaf.mesh.bounds());
    parts.fold(mesh.bounds(), |all, part| all.union(&part)).center()
}

#[cfg(test)]
mod tests {
    use super::super::tests::{Desk, HEAD, read};
    use crate::import::ImportOptions;
    use crate::import::assets::Collect;
    use crate::stream::schema::names;

    /// A card whose texture is opaque where x + y, v pointing up, is below one: beneath its diagonal. Its red channel is
    /// 102 everywhere. Another face has a material of its own by a subset.
    fn card(threshold: f32, channel: &str) -> Desk {
        let desk = Desk::new();
        let image = image::RgbaImage::from_fn(64, 64, |x, y| {
            image::Rgba([102, 0, 0, if x + (63 - y) < 63 { 255 } else { 0 }])
        });
        std::fs::create_dir(desk.0.path().join("textures")).unwrap();
        image.save(desk.0.path().join("textures/leaf.png")).unwrap();
        let card = format!(
            r#"{HEAD}def Mesh "card" (prepend apiSchemas = ["MaterialBindingAPI"]) {{
    int[] faceVertexCounts = [4, 3]
    int[] faceVertexIndices = [0, 1, 2, 3, 1, 4, 2]
    point3f[] points = [(0,0,0), (1,0,0), (1,1,0), (0,1,0), (2,0,0)]
    uniform token subdivisionScheme = "none"
    texCoord2f[] primvars:uv = [(0,0), (1,0), (1,1), (0,1), (0,0), (0,0), (0,0)] ( interpolation = "faceVarying" )
    color3f[] primvars:displayColor = [(0.25, 0.5, 0.75)]
    rel material:binding = </Leaf>
    def GeomSubset "half" {{
        uniform token elementType = "face"
        uniform token familyName = "materialBind"
        int[] indices = [1]
        rel material:binding = </Glass>
    }}
}}
def Material "Leaf" {{
    token outputs:surface.connect = </Leaf/Surface.outputs:surface>
    def Shader "Surface" {{
        uniform token info:id = "UsdPreviewSurface"
        float inputs:opacity.connect = </Leaf/Image.outputs:{channel}>
        float inputs:opacityThreshold = {threshold}
        token outputs:surface
    }}
    def Shader "Image" {{
        uniform token info:id = "UsdUVTexture"
        asset inputs:file = @./textures/leaf.png@
        float2 inputs:st.connect = </Leaf/Reader.outputs:result>
        token inputs:wrapS = "clamp"
    }}
    def Shader "Reader" {{
        uniform token info:id = "UsdPrimvarReader_float2"
        string inputs:varname = "uv"
    }}
}}
def Material "Glass" {{
    token outputs:surface.connect = </Glass/Surface.outputs:surface>
    def Shader "Surface" {{
        uniform token info:id = "UsdPreviewSurface"
        float inputs:opacity = 0.4
        token outputs:surface
    }}
}}
"#
        );
        desk.layer("card.usda", &card);
        desk
    }

    fn import(desk: &Desk, texels: Option<f64>) -> Collect {
        let options = ImportOptions { texels, ..ImportOptions::default() };
        let (sink, report) = read(&desk.0.path().join("card.usda"), &options).unwrap();
        assert_eq!(report.warnings, [""; 0]);
        sink
    }

    /// The area that a card's faces cover, by opacity, left of x = 1 and right of it.
    fn cover(sink: &Collect) -> [f64; 2] {
        let column = sink.schema.find(names::OPACITY).unwrap();
        let mut sums = [0.0; 2];
        for grid in &sink.grids {
            for face in grid.faces() {
                let points: Vec<_> = face.iter().map(|&v| grid.position(usize::from(v))).collect();
                let area = crate::import::polygon::area_normal(&points).length() / 2.0;
                let opacity = grid.unit_value(&sink.schema, column, usize::from(face[0]), 0);
                let is_right = points.iter().map(|p| p.x).sum::<f64>() > points.len() as f64;
                sums[usize::from(is_right)] += area * f64::from(opacity);
            }
        }
        sums
    }

    /// Catches an opacity that is not read, is of another channel, upside down, or of another face's material.
    #[test]
    fn opacity_is_read_from_textures_and_numbers() {
        for (threshold, channel, expected) in
            [(0.0, "a", 0.5), (0.5, "a", 0.5), (0.0, "r", 0.4), (0.5, "r", 0.0)]
        {
            let desk = card(threshold, channel);
            for texels in [None, Some(2.0)] {
                let [left, right] = cover(&import(&desk, texels));
                assert!((left - expected).abs() < 0.02, "{channel} {threshold} {texels:?}: {left}");
                assert!((right - 0.5 * 0.4).abs() < 0.005, "{right}");
            }
        }
    }

    /// Catches a leaf that is cut the wrong way up, and attributes that are lost or wrong on its parts.
    #[test]
    fn leaves_are_cut_along_their_texture() {
        let sink = import(&card(0.5, "a"), Some(2.0));
        let column = |name| sink.schema.find(name).unwrap();
        let (opacity, uv, albedo) = (column(names::OPACITY), column("uv"), column(names::ALBEDO));
        let (mut parts, mut corners) = (0, 0);
        for grid in &sink.grids {
            for vertex in 0..grid.vertex_count() {
                let p = grid.position(vertex);
                if grid.unit_value(&sink.schema, opacity, vertex, 0) < 0.9 {
                    continue;
                }
                parts += 1;
                assert!(p.x + p.y < 1.05, "{p}");
                let at = |i| f64::from(grid.value(&sink.schema, uv, vertex, i));
                assert!((at(0) - p.x).abs() < 1e-5 && (at(1) - p.y).abs() < 1e-5);
                let color = grid.vec3(&sink.schema, albedo, vertex);
                assert!((color - glam::Vec3::new(0.25, 0.5, 0.75)).length() < 0.01, "{color}");
                let point = grid.columns[column(names::POINT)][4 * vertex..4 * vertex + 4].to_vec();
                corners += usize::from(point != [255; 4]);
            }
        }
        assert!(parts > 100 && corners > 0, "{parts} {corners}");
    }
}
