//! Clusters of a mesh become microgrids in world space.
//!
//! Positions keep what they have. A mesh of single precision numbers that is not moved is written as it is, with the
//! anchor at the origin. Any other is rounded to a power of two that a grid of its size resolves in single precision,
//! per vertex the coarsest of the grids that share it: so a shared vertex is the same number in all of them.

use glam::{DMat3, DMat4, DVec3, Vec3};

use super::cut::{Clusters, VertexKey, VertexTable};
use super::mesh::{COORDINATE_MAX, Face, Mesh, NO_NORMAL};
use super::{GridSink, ImportReport, polygon, srgb};
use crate::Result;
use crate::stream::schema::names;
use crate::stream::{Attribute, Microgrid, Schema, ValueType};

/// Which attributes a stream carries, decided before its first grid.
#[derive(Clone, Debug, Default)]
pub(super) struct Carried {
    /// `N`.
    pub normal: bool,
    /// `albedo`.
    pub albedo: bool,
    /// `opacity`.
    pub opacity: bool,
    /// `radius`.
    pub radius: bool,
    /// Further attributes of f32 per vertex, in the order of [`Mesh::extras`].
    pub extras: Vec<Attribute>,
    /// `point`.
    pub point: bool,
}

impl Carried {
    /// What a finished mesh needs.
    pub fn by(mesh: &Mesh) -> Self {
        Self {
            normal: mesh.has_normals(),
            albedo: !mesh.colors.is_empty() || !mesh.palette.is_empty(),
            opacity: mesh.has_opacity(),
            radius: mesh.has_radii(),
            ..Self::default()
        }
    }

    /// The attributes in their order: `N albedo opacity radius`, further ones, `point id`.
    fn attributes(&self) -> Vec<Attribute> {
        let first = [
            (self.normal, Attribute::vertex(names::NORMAL, ValueType::F32, 3)),
            (self.albedo, Attribute::vertex(names::ALBEDO, ValueType::U8, 3)),
            (self.opacity, Attribute::vertex(names::OPACITY, ValueType::U8, 1)),
            (self.radius, Attribute::vertex(names::RADIUS, ValueType::F32, 1)),
        ];
        let last = [
            (self.point, Attribute::vertex(names::POINT, ValueType::U32, 1)),
            (true, Attribute::grid(names::ID, ValueType::U32, 1)),
        ];
        let wanted = |(carried, attribute): (bool, Attribute)| carried.then_some(attribute);
        let first = first.into_iter().filter_map(wanted).chain(self.extras.iter().cloned());
        first.chain(last.into_iter().filter_map(wanted)).collect()
    }
}

/// Where a copy of a mesh stands.
#[derive(Clone, Copy, Debug)]
pub(super) struct Placement {
    world_from_mesh: DMat4,
    /// Takes normals along: the cofactors, which are the inverse transpose up to a positive factor once the sign of
    /// the determinant is put right.
    world_from_normal: DMat3,
    pub mirrored: bool,
    /// Radii grow by this.
    pub scale: f64,
    identity: bool,
}

impl Placement {
    /// The placement that leaves a mesh where it is.
    pub const HERE: Self = Self {
        world_from_mesh: DMat4::IDENTITY,
        world_from_normal: DMat3::IDENTITY,
        mirrored: false,
        scale: 1.0,
        identity: true,
    };

    /// A placement, unless the matrix is not finite or flattens space.
    pub fn new(world_from_mesh: DMat4) -> Option<Self> {
        let linear = DMat3::from_mat4(world_from_mesh);
        let determinant = linear.determinant();
        let usable = world_from_mesh.is_finite() && determinant.is_finite() && determinant != 0.0;
        if !usable {
            return None;
        }
        let [x, y, z] = [linear.x_axis, linear.y_axis, linear.z_axis];
        let cofactors = DMat3::from_cols(y.cross(z), z.cross(x), x.cross(y));
        Some(Self {
            world_from_mesh,
            world_from_normal: cofactors * determinant.signum(),
            mirrored: determinant < 0.0,
            // The mean of the axes' lengths: exact for uniform scales, and free of functions that differ by platform
            scale: (x.length() + y.length() + z.length()) / 3.0,
            identity: world_from_mesh == DMat4::IDENTITY,
        })
    }

    /// Whether it leaves a mesh where it is.
    pub fn is_identity(&self) -> bool {
        self.identity
    }

    /// Where a point stands.
    pub fn point(&self, point: DVec3) -> DVec3 {
        if self.identity { point } else { self.world_from_mesh.transform_point3(point) }
    }

    /// A normal along with its face, of unit length.
    pub fn normal(&self, normal: Vec3) -> Vec3 {
        if self.identity {
            return normal.normalize_or_zero();
        }
        (self.world_from_normal * normal.as_dvec3()).normalize_or_zero().as_vec3()
    }
}

/// Hands grids to a sink and counts them.
pub(super) struct Emitter<'a> {
    sink: &'a mut dyn GridSink,
    pub schema: Schema,
    carried: Carried,
    pub grid: Microgrid,
    table: VertexTable,
    /// Power of two per position, see [`Emitter::measure`]; empty when positions are written as they are.
    pub exponents: Vec<i16>,
    /// Where the vertices of the grid stand.
    pub points: Vec<DVec3>,
}

/// Albedo where nothing says otherwise, as everywhere in the engine: a half.
const ALBEDO_DEFAULT: [u8; 3] = [128; 3];

/// Smallest power of two for rounding; below it nothing can be told apart.
const EXPONENT_MIN: i16 = -200;

impl<'a> Emitter<'a> {
    /// Begins a stream.
    pub fn new(sink: &'a mut dyn GridSink, carried: Carried, options: &super::ImportOptions) -> Result<Self> {
        Self::with_metadata(sink, carried, options, &[])
    }

    /// Begins a stream that says `metadata` about itself.
    pub fn with_metadata(
        sink: &'a mut dyn GridSink,
        carried: Carried,
        options: &super::ImportOptions,
        metadata: &[(String, String)],
    ) -> Result<Self> {
        let schema = Schema {
            meters_per_unit: options.meters_per_unit,
            up: options.up,
            attributes: carried.attributes(),
        };
        schema.validate()?;
        sink.begin(&schema, metadata)?;
        Ok(Self {
            sink,
            schema,
            carried,
            grid: Microgrid::default(),
            table: VertexTable::new(),
            exponents: Vec::new(),
            points: Vec::new(),
        })
    }

    /// Ends what stands in the world: grids that follow are a prototype's.
    pub fn copies(&mut self, copies: &super::Copies) -> Result<()> {
        self.sink.copies(copies)
    }

    /// Writes a copy of a mesh, diced if `rate` says how.
    pub fn emit_diced(
        &mut self,
        mesh: &Mesh,
        clusters: &Clusters,
        placement: &Placement,
        rate: Option<&crate::dice::Rate>,
        ids: (u32, f32),
        report: &mut ImportReport,
    ) -> Result<()> {
        match rate {
            Some(rate) => super::diced::emit(self, mesh.clone(), placement, (rate, None), ids, report),
            None => self.emit(mesh, clusters, placement, ids, report),
        }
    }

    /// Writes a copy of a mesh. Faces carry their object's number as `id`, from `first_id`.
    pub fn emit(
        &mut self,
        mesh: &Mesh,
        clusters: &Clusters,
        placement: &Placement,
        (first_id, radius): (u32, f32),
        report: &mut ImportReport,
    ) -> Result<()> {
        if self.is_out_of_range(mesh, placement, report) {
            return Ok(());
        }
        self.measure(mesh, clusters, placement);
        for cluster in clusters.iter() {
            self.fill(mesh, cluster, placement, radius);
            self.hand_over(first_id.wrapping_add(mesh.faces[cluster[0] as usize].object), report)?;
        }
        Ok(())
    }

    /// Whether a copy stands beyond what can be stored; it is counted then.
    pub fn is_out_of_range(&self, mesh: &Mesh, placement: &Placement, report: &mut ImportReport) -> bool {
        let bounds = mesh.bounds();
        let far = |p: DVec3| !placement.point(p).abs().cmple(DVec3::splat(COORDINATE_MAX)).all();
        let is_far = !bounds.is_empty() && (far(bounds.min) || far(bounds.max));
        report.skip("copies that stand out of range", u64::from(is_far));
        is_far
    }

    /// Empties the grid.
    pub fn begin_grid(&mut self) {
        self.grid.clear(self.schema.attributes.len());
        self.points.clear();
    }

    /// Hands the grid, complete but for its `id`, to the sink.
    pub fn hand_over(&mut self, id: u32, report: &mut ImportReport) -> Result<()> {
        let column = self.schema.attributes.len() - 1;
        self.grid.columns[column].extend_from_slice(&id.to_le_bytes());
        debug_assert_eq!(self.grid.validate(&self.schema).err().map(|e| e.to_string()), None);
        report.grids += 1;
        report.micropolygons += self.grid.face_count() as u64;
        report.vertices += self.grid.vertex_count() as u64;
        self.sink.grid(&self.grid)
    }

    /// Finds for every position the power of two to round to.
    fn measure(&mut self, mesh: &Mesh, clusters: &Clusters, placement: &Placement) {
        self.exponents.clear();
        if placement.identity && mesh.single_precision {
            return;
        }
        self.exponents.resize(mesh.positions.len(), EXPONENT_MIN);
        for cluster in clusters.iter() {
            let mut bounds = crate::math::Bounds::EMPTY;
            let corners = |face: &u32| mesh.face_corners(&mesh.faces[*face as usize]);
            for &corner in cluster.iter().flat_map(corners) {
                bounds.add(placement.point(mesh.positions[corner as usize]));
            }
            let exponent = resolution(bounds.size().max_element());
            for &corner in cluster.iter().flat_map(corners) {
                let known = &mut self.exponents[corner as usize];
                *known = exponent.max(*known);
            }
        }
    }

    /// Makes the grid of one cluster, but for its `id`.
    fn fill(&mut self, mesh: &Mesh, cluster: &[u32], placement: &Placement, radius: f32) {
        self.begin_grid();
        self.table.clear();
        for &index in cluster {
            let face = &mesh.faces[index as usize];
            let mut indices = [0_u8; 4];
            for (i, slot) in indices.iter_mut().enumerate().take(face.arity as usize) {
                let corner = face.start as usize + i;
                let (vertex, is_new) = self.table.add(VertexKey::new(mesh, face, corner));
                *slot = vertex as u8;
                if is_new {
                    self.push_vertex(mesh, face, corner, placement, radius);
                }
            }
            let indices = &mut indices[..face.arity as usize];
            if placement.mirrored && face.arity > 2 {
                // Keeps the first corner, and with it a quad's diagonal
                indices[1..].reverse();
            }
            self.grid.push_face(indices);
        }
        self.place(!self.exponents.is_empty());
    }

    /// Adds a vertex with all that it carries, but for its place in the grid.
    pub fn push_vertex(
        &mut self,
        mesh: &Mesh,
        face: &Face,
        corner: usize,
        placement: &Placement,
        radius: f32,
    ) {
        let position = mesh.corners[corner] as usize;
        let variant = mesh.variant(corner);
        let mut point = placement.point(mesh.positions[position]);
        if let Some(&exponent) = self.exponents.get(position) {
            let step = power_of_two(exponent);
            point = (point / step).round() * step;
        }
        self.points.push(point);
        let mut column = 0;
        let mut next = |carried: bool| carried.then(|| (column, column += 1).0);
        if let Some(column) = next(self.carried.normal) {
            let normal = corner_normal(mesh, face, corner, placement);
            for value in normal.to_array() {
                self.grid.columns[column].extend_from_slice(&value.to_le_bytes());
            }
        }
        if let Some(column) = next(self.carried.albedo) {
            let variant = variant.and_then(|variant| mesh.variant_colors.get(variant as usize));
            let from_palette = || mesh.palette.get(face.material as usize).copied().unwrap_or(ALBEDO_DEFAULT);
            let albedo = variant.or_else(|| mesh.colors.get(position)).copied().unwrap_or_else(from_palette);
            self.grid.columns[column].extend_from_slice(&albedo);
        }
        if let Some(column) = next(self.carried.opacity) {
            let variant = variant.and_then(|variant| mesh.variant_opacities.get(variant as usize));
            let opacity = variant.or_else(|| mesh.opacities.get(position)).copied().unwrap_or(face.opacity);
            self.grid.columns[column].push(opacity);
        }
        if let Some(column) = next(self.carried.radius) {
            let own = match mesh.radii.get(position) {
                _ if face.arity > 2 => 0.0,
                Some(&radius) if radius.is_finite() && radius >= 0.0 => f64::from(radius),
                _ => f64::from(radius),
            };
            let radius = (own * placement.scale) as f32;
            self.grid.columns[column].extend_from_slice(&radius.to_le_bytes());
        }
        for (i, attribute) in self.carried.extras.iter().enumerate() {
            let value = mesh.extras.get(i).and_then(|extra| extra.at(position, variant));
            let column = &mut self.grid.columns[column + i];
            match value {
                Some(value) => column.extend(value.iter().flat_map(|value| value.to_le_bytes())),
                None => column.resize(column.len() + attribute.value_bytes(), 0),
            }
        }
        if self.carried.point {
            let number = mesh.point_numbers.get(position).copied().unwrap_or(position as u32);
            let column = &mut self.grid.columns[column + self.carried.extras.len()];
            column.extend_from_slice(&number.to_le_bytes());
        }
    }

    /// Chooses the anchor and stores positions as offsets from it: the origin unless they were rounded.
    pub fn place(&mut self, rounded: bool) {
        if rounded {
            let mut bounds = crate::math::Bounds::EMPTY;
            self.points.iter().for_each(|&point| bounds.add(point));
            let step = power_of_two(resolution(bounds.size().max_element()));
            self.grid.anchor = (bounds.center() / step).round() * step;
        }
        let anchor = self.grid.anchor;
        self.grid.positions.extend(self.points.iter().map(|&point| (point - anchor).as_vec3()));
    }
}

/// A corner's unit normal in world space: the file's, else the smooth one, else that of the face; zero for points and
/// lines without one.
pub(super) fn corner_normal(mesh: &Mesh, face: &Face, corner: usize, placement: &Placement) -> Vec3 {
    let position = mesh.corners[corner] as usize;
    let index = mesh.normal_index(corner);
    let given = if index == NO_NORMAL { mesh.smooth.get(position) } else { mesh.normals.get(index as usize) };
    let normal = placement.normal(given.copied().unwrap_or(Vec3::ZERO));
    if normal != Vec3::ZERO && normal.is_finite() || face.arity < 3 {
        return if normal.is_finite() { normal } else { Vec3::ZERO };
    }
    let mut points = [DVec3::ZERO; 4];
    let corners = mesh.face_corners(face);
    for (point, &corner) in points.iter_mut().zip(corners) {
        *point = mesh.positions[corner as usize];
    }
    let normal = polygon::area_normal(&points[..corners.len()]).normalize_or_zero();
    placement.normal(normal.as_vec3())
}

/// The exponent of the finest power of two of which a box of this size holds at most 2^24 along an edge.
pub(super) fn resolution(size: f64) -> i16 {
    // The exponent of the next power of two, from the bits: the same on every machine
    let exponent = ((size.to_bits() >> 52) & 0x7ff) as i16 - 1023 + 1;
    (exponent - 24).max(EXPONENT_MIN)
}

/// 2 to an exponent of a normal number.
pub(super) fn power_of_two(exponent: i16) -> f64 {
    f64::from_bits(((i64::from(exponent) + 1023) as u64) << 52)
}

/// The byte of an opacity in 0 to 1. What covers anything at all stays above zero.
pub(super) fn opacity_byte(opacity: f32) -> u8 {
    let byte = srgb::unit_byte(opacity);
    if opacity > 0.0 { byte.max(1) } else { byte }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::import::assets::Collect;
    use crate::import::cut;
    use std::collections::BTreeMap;

    const FACE: Face = Face { start: 0, arity: 0, material: 0, object: 0, opacity: 255, hole: false };

    /// A bumpy sheet of `n` by `n` quads, of decimals that single precision does not hold.
    fn sheet(n: u32) -> Mesh {
        let mut mesh = Mesh::default();
        let mut report = ImportReport::default();
        for i in 0..(n + 1) * (n + 1) {
            let (x, y) = (f64::from(i % (n + 1)), f64::from(i / (n + 1)));
            mesh.positions.push(DVec3::new(0.1 * x, 0.1 * y, 0.0007 * ((x * 7.0 + y * 3.0) % 5.0)));
        }
        for i in 0..n * n {
            let at = i / n * (n + 1) + i % n;
            mesh.push_face(FACE, &[at, at + 1, at + n + 2, at + n + 1], &mut report).unwrap();
        }
        mesh.finish(&mut report).unwrap();
        mesh
    }

    fn emit(mesh: &Mesh, placement: &Placement) -> Collect {
        let mut sink = Collect::default();
        let mut emitter = Emitter::new(&mut sink, Carried::by(mesh), &Default::default()).unwrap();
        emitter.emit(mesh, &cut::cut(mesh), placement, (0, 0.0), &mut ImportReport::default()).unwrap();
        sink
    }

    /// Catches a shared vertex that is another number in the next grid: a crack, and a false hit from its own corner.
    #[test]
    fn shared_vertices_are_equal_in_all_grids() {
        let far = DMat4::from_translation(DVec3::new(4e6, -3e5, 12.0))
            * DMat4::from_rotation_y(0.3)
            * DMat4::from_scale(DVec3::splat(0.731));
        for placement in [Placement::HERE, Placement::new(far).unwrap()] {
            let mesh = sheet(60);
            let sink = emit(&mesh, &placement);
            let mut known = BTreeMap::new();
            for grid in &sink.grids {
                for vertex in 0..grid.vertex_count() {
                    let p = grid.position(vertex);
                    let near = (p * 100.0).round().to_array().map(|x| x as i64);
                    assert_eq!(*known.entry(near).or_insert(p), p);
                }
            }
            assert_eq!(known.len(), mesh.positions.len());
            assert!(sink.grids.len() > 10);
        }
    }

    /// Catches normals that point to the other side of their faces after a mirror or a scale that is not uniform.
    #[test]
    fn normals_follow_their_faces() {
        for scale in [DVec3::new(1.0, 1.0, 1.0), DVec3::new(-2.0, 0.3, 5.0), DVec3::new(-1.0, -1.0, -4.0)] {
            let placement = Placement::new(DMat4::from_rotation_x(1.0) * DMat4::from_scale(scale)).unwrap();
            let sink = emit(&sheet(12), &placement);
            for grid in &sink.grids {
                for face in grid.faces() {
                    let points: Vec<DVec3> = face.iter().map(|&v| grid.position(usize::from(v))).collect();
                    let normal = polygon::area_normal(&points).normalize();
                    for &vertex in face {
                        let own = grid.vec3(&sink.schema, 0, usize::from(vertex)).as_dvec3();
                        assert!(
                            (own.length() - 1.0).abs() < 1e-6 && own.dot(normal) > 0.0,
                            "{scale} {own} {normal}"
                        );
                    }
                }
            }
        }
    }

    /// Catches a placement that divides by zero or spreads what is not a number.
    #[test]
    fn flat_and_broken_placements_are_refused() {
        assert!(Placement::new(DMat4::from_scale(DVec3::new(1.0, 0.0, 1.0))).is_none());
        assert!(Placement::new(DMat4::from_scale(DVec3::splat(f64::NAN))).is_none());
        assert!(Placement::new(DMat4::from_translation(DVec3::splat(f64::INFINITY))).is_none());
    }

    /// Catches a rounding step that a grid cannot hold in single precision, at every power of two.
    #[test]
    fn the_step_of_a_grid_is_fine_and_fits() {
        for exponent in -100..100 {
            for share in [1.0, 1.5, 1.999] {
                let size = share * power_of_two(exponent);
                let steps = size / power_of_two(resolution(size));
                assert!((2_f64.powi(23)..=2_f64.powi(24)).contains(&steps), "{size} {steps}");
            }
        }
        assert_eq!(resolution(0.0), EXPONENT_MIN);
    }
}
