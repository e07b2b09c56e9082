//! Embree 4 as far as the comparison needs it, found at run time: no header, no link, nothing to install for a build.

use std::ffi::{CString, c_char, c_int, c_uint, c_void};

type Handle = *mut c_void;

unsafe extern "C" {
    fn dlopen(name: *const c_char, flags: c_int) -> Handle;
    fn dlsym(library: Handle, name: *const c_char) -> Handle;
}

/// A ray with its hit, as `rtcIntersect1` and, without the hit, `rtcOccluded1` take it.
#[repr(C, align(16))]
#[derive(Clone, Copy)]
struct RayHit {
    origin: [f32; 3],
    near: f32,
    direction: [f32; 3],
    time: f32,
    far: f32,
    mask: c_uint,
    id: c_uint,
    flags: c_uint,
    hit: [c_uint; 16],
}

/// Sixteen rays with their hits, as `rtcIntersect16` and `rtcOccluded16` take them.
#[repr(C, align(64))]
struct RayHit16 {
    origin: [[f32; 16]; 3],
    near: [f32; 16],
    direction: [[f32; 16]; 3],
    time: [f32; 16],
    far: [f32; 16],
    mask: [c_uint; 16],
    id: [c_uint; 16],
    flags: [c_uint; 16],
    hit: [[c_uint; 16]; 12],
}

/// Where a hit's geometry is told: after the normal, the coordinates and the primitive.
const GEOMETRY: usize = 6;
const NO_GEOMETRY: c_uint = u32::MAX;

/// The library's functions.
struct Functions {
    new_device: unsafe extern "C" fn(*const c_char) -> Handle,
    new_scene: unsafe extern "C" fn(Handle) -> Handle,
    new_geometry: unsafe extern "C" fn(Handle, c_int) -> Handle,
    new_buffer: unsafe extern "C" fn(Handle, c_int, c_uint, c_int, usize, usize) -> *mut c_void,
    commit_geometry: unsafe extern "C" fn(Handle),
    attach_geometry: unsafe extern "C" fn(Handle, Handle) -> c_uint,
    commit_scene: unsafe extern "C" fn(Handle),
    occluded1: unsafe extern "C" fn(Handle, *mut RayHit, *const c_void),
    occluded16: unsafe extern "C" fn(*const c_int, Handle, *mut RayHit16, *const c_void),
    intersect1: unsafe extern "C" fn(Handle, *mut RayHit, *const c_void),
    intersect16: unsafe extern "C" fn(*const c_int, Handle, *mut RayHit16, *const c_void),
}

/// Embree's ways to ask whether something is in the way.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Query {
    /// Any hit, ray by ray.
    Occluded1,
    /// Any hit, sixteen rays of a point together.
    Occluded16,
    /// Nearest hit, ray by ray: in foliage its order makes it faster than any hit.
    Intersect1,
    /// Nearest hit, sixteen rays together.
    Intersect16,
}

/// All of them.
pub const QUERIES: [Query; 4] = [Query::Occluded1, Query::Occluded16, Query::Intersect1, Query::Intersect16];

/// Triangles in Embree's tree.
pub struct Scene {
    functions: Functions,
    scene: Handle,
}

// SAFETY: a committed scene is only read
unsafe impl Sync for Scene {}

impl Scene {
    /// Builds Embree's tree; none if the library is not there. `triangles` has three vertices each.
    pub fn build(library: &str, vertices: &[[f32; 3]], triangles: &[[u32; 3]]) -> Option<Self> {
        let functions = Functions::load(library)?;
        // SAFETY: the functions are Embree 4's, called as its documentation says; buffers have the size asked for
        unsafe {
            let device = (functions.new_device)(std::ptr::null());
            let scene = (functions.new_scene)(device);
            // Triangles; vertex buffer of 3 floats (0x9003), index buffer of 3 unsigned numbers (0x5003)
            let geometry = (functions.new_geometry)(device, 0);
            let to = (functions.new_buffer)(geometry, 1, 0, 0x9003, 12, vertices.len());
            std::ptr::copy_nonoverlapping(vertices.as_ptr().cast(), to.cast::<u8>(), 12 * vertices.len());
            let to = (functions.new_buffer)(geometry, 0, 0, 0x5003, 12, triangles.len());
            std::ptr::copy_nonoverlapping(triangles.as_ptr().cast(), to.cast::<u8>(), 12 * triangles.len());
            (functions.commit_geometry)(geometry);
            (functions.attach_geometry)(scene, geometry);
            (functions.commit_scene)(scene);
            Some(Self { functions, scene })
        }
    }

    /// Which of the rays from `origin` meet something farther than `near`.
    pub fn occluded(&self, query: Query, origin: [f32; 3], near: f32, rays: &[[f32; 4]], out: &mut [bool]) {
        match query {
            Query::Occluded1 | Query::Intersect1 => {
                for (direction, out) in rays.iter().zip(out) {
                    *out = self.one(query, origin, near, direction);
                }
            }
            Query::Occluded16 | Query::Intersect16 => {
                for (rays, out) in rays.chunks(16).zip(out.chunks_mut(16)) {
                    self.sixteen(query, origin, near, rays, out);
                }
            }
        }
    }

    fn one(&self, query: Query, origin: [f32; 3], near: f32, direction: &[f32; 4]) -> bool {
        let mut ray = RayHit {
            origin,
            near,
            direction: [direction[0], direction[1], direction[2]],
            time: 0.0,
            far: f32::INFINITY,
            mask: u32::MAX,
            id: 0,
            flags: 0,
            hit: [NO_GEOMETRY; 16],
        };
        // SAFETY: the scene is committed; no arguments are the default ones
        unsafe {
            if query == Query::Occluded1 {
                (self.functions.occluded1)(self.scene, &mut ray, std::ptr::null());
                return ray.far < 0.0;
            }
            (self.functions.intersect1)(self.scene, &mut ray, std::ptr::null());
        }
        ray.hit[GEOMETRY] != NO_GEOMETRY
    }

    fn sixteen(&self, query: Query, origin: [f32; 3], near: f32, rays: &[[f32; 4]], out: &mut [bool]) {
        #[repr(align(64))]
        struct Valid([c_int; 16]);
        let valid = Valid(std::array::from_fn(|i| if i < rays.len() { -1 } else { 0 }));
        let last = rays.len() - 1;
        let mut packet = RayHit16 {
            origin: origin.map(|x| [x; 16]),
            near: [near; 16],
            direction: [0, 1, 2].map(|axis| std::array::from_fn(|i| rays[i.min(last)][axis])),
            time: [0.0; 16],
            far: [f32::INFINITY; 16],
            mask: [u32::MAX; 16],
            id: [0; 16],
            flags: [0; 16],
            hit: [[NO_GEOMETRY; 16]; 12],
        };
        // SAFETY: as for one
        unsafe {
            if query == Query::Occluded16 {
                (self.functions.occluded16)(valid.0.as_ptr(), self.scene, &mut packet, std::ptr::null());
                out.iter_mut().zip(&packet.far).for_each(|(out, &far)| *out = far < 0.0);
                return;
            }
            (self.functions.intersect16)(valid.0.as_ptr(), self.scene, &mut packet, std::ptr::null());
        }
        out.iter_mut().zip(&packet.hit[GEOMETRY]).for_each(|(out, &hit)| *out = hit != NO_GEOMETRY);
    }
}

impl Functions {
    fn load(library: &str) -> Option<Self> {
        let name = CString::new(library).ok()?;
        // SAFETY: names are terminated; 2 binds all symbols now
        let library = unsafe { dlopen(name.as_ptr(), 2) };
        if library.is_null() {
            return None;
        }
        let symbol = |name: &str| {
            let name = CString::new(name).ok()?;
            // SAFETY: the library is open and stays so
            let symbol = unsafe { dlsym(library, name.as_ptr()) };
            (!symbol.is_null()).then_some(symbol)
        };
        // SAFETY: these are Embree 4's signatures
        unsafe {
            Some(Self {
                new_device: std::mem::transmute_copy(&symbol("rtcNewDevice")?),
                new_scene: std::mem::transmute_copy(&symbol("rtcNewScene")?),
                new_geometry: std::mem::transmute_copy(&symbol("rtcNewGeometry")?),
                new_buffer: std::mem::transmute_copy(&symbol("rtcSetNewGeometryBuffer")?),
                commit_geometry: std::mem::transmute_copy(&symbol("rtcCommitGeometry")?),
                attach_geometry: std::mem::transmute_copy(&symbol("rtcAttachGeometry")?),
                commit_scene: std::mem::transmute_copy(&symbol("rtcCommitScene")?),
                occluded1: std::mem::transmute_copy(&symbol("rtcOccluded1")?),
                occluded16: std::mem::transmute_copy(&symbol("rtcOccluded16")?),
                intersect1: std::mem::transmute_copy(&symbol("rtcIntersect1")?),
                intersect16: std::mem::transmute_copy(&symbol("rtcIntersect16")?),
            })
        }
    }
}
