//! Where plants stand: jittered lattices, one per storey, thinned by clearing, path and patchiness.

use crate::math::hash::{combine, unit_f32};
use crate::scene::ProceduralKind;

use super::noise::{noise, smoothstep};
use super::plant::{Site, Species};
use super::trig::sincos;

/// One storey: candidates stand on a jittered lattice; each is kept with a chance that depends on the place.
struct Storey {
    /// Metres between candidates.
    spacing: f32,
    /// The species and their shares.
    species: &'static [(Species, f32)],
    /// Chance that a candidate in the open forest, or meadow, is kept.
    chance: f32,
    /// Chance inside the clearing, relative to `chance`.
    in_clearing: f32,
    /// How much stronger the storey is at the clearing's sunny edge.
    at_edge: f32,
    /// Metres beyond the clearing's radius from which the storey grows.
    setback: f32,
    /// Whether the storey is thinned or thickened to meet the count asked for.
    adjustable: bool,
}

use Species::*;

const JUNGLE: &[Storey] = &[
    Storey {
        spacing: 7.8,
        species: &[(Giant, 1.0)],
        chance: 0.85,
        in_clearing: 0.0,
        at_edge: 0.0,
        setback: 2.2,
        adjustable: false,
    },
    Storey {
        spacing: 3.5,
        species: &[(Sapling, 0.62), (Palm, 0.24), (TreeFern, 0.14)],
        chance: 0.56,
        in_clearing: 0.0,
        at_edge: 0.2,
        setback: 1.2,
        adjustable: false,
    },
    Storey {
        spacing: 2.2,
        species: &[(Banana, 0.29), (Shrub, 0.3), (ElephantEar, 0.18), (SplitLeaf, 0.2), (TreeFern, 0.03)],
        chance: 0.55,
        in_clearing: 0.0,
        at_edge: 0.5,
        setback: -0.8,
        adjustable: true,
    },
    Storey {
        spacing: 1.1,
        species: &[(Fern, 0.46), (Shrub, 0.1), (ElephantEar, 0.16), (SplitLeaf, 0.12), (Rosette, 0.16)],
        chance: 0.46,
        in_clearing: 0.16,
        at_edge: 0.35,
        setback: -1.6,
        adjustable: true,
    },
    Storey {
        spacing: 4.2,
        species: &[(Stone, 0.45), (Log, 0.25), (Mushrooms, 0.3)],
        chance: 0.5,
        in_clearing: 0.7,
        at_edge: 0.0,
        setback: 0.0,
        adjustable: true,
    },
    Storey {
        spacing: 0.27,
        species: &[(Grass, 0.52), (Litter, 0.32), (Rosette, 0.16)],
        chance: 0.46,
        in_clearing: 2.3,
        at_edge: 0.25,
        setback: 0.0,
        adjustable: true,
    },
];

const MEADOW: &[Storey] = &[
    Storey {
        spacing: 6.0,
        species: &[(Stone, 0.7), (Shrub, 0.3)],
        chance: 0.22,
        in_clearing: 1.0,
        at_edge: 0.0,
        setback: 0.0,
        adjustable: true,
    },
    Storey {
        spacing: 0.4,
        species: &[(TallGrass, 0.45), (Flower, 0.55)],
        chance: 0.6,
        in_clearing: 1.0,
        at_edge: 0.0,
        setback: 0.0,
        adjustable: true,
    },
    Storey {
        spacing: 0.15,
        species: &[(Grass, 0.93), (Rosette, 0.07)],
        chance: 0.66,
        in_clearing: 1.0,
        at_edge: 0.0,
        setback: 0.0,
        adjustable: true,
    },
];

/// The demo camera's foot and where it looks, metres.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Stand {
    /// x and z of the camera.
    pub foot: [f32; 2],
    /// Metres above ground.
    pub eye: f32,
    /// x and z of a point in the middle of the picture.
    pub target: [f32; 2],
    /// Height of that point above the ground there.
    pub target_height: f32,
    /// Vertical field of view in degrees.
    pub fov_degrees: f64,
}

/// The plan of a planted world without end; a stream shows a square of it.
#[derive(Clone, Debug)]
pub struct Scatter {
    kind: ProceduralKind,
    seed: u32,
    /// Radius of the clearing in metres.
    pub clearing: f32,
    /// Multiplies the chance of adjustable storeys.
    pub density: f32,
    /// Quads a plant may have: small streams hold no large plants.
    pub plant_quads_max: f64,
    /// Mean quads of each species, in the order of [`Species::ALL`].
    pub mean_quads: [f64; Species::ALL.len()],
    stand: Stand,
}

/// A candidate that might be kept.
struct Candidate {
    site: Site,
    /// Chance of being kept at density 1; from 0 to 1.
    chance: f32,
    /// Draw against the chance.
    draw: f32,
    adjustable: bool,
}

impl Scatter {
    /// The plan of a kind. `half` is half the visible square's side in metres.
    pub fn new(kind: ProceduralKind, seed: u32, half: f32, mean_quads: [f64; Species::ALL.len()]) -> Self {
        let clearing = (0.42 * half).min(7.5);
        Self {
            kind,
            seed,
            clearing,
            density: 1.0,
            plant_quads_max: f64::INFINITY,
            mean_quads,
            stand: stand(kind, half, clearing),
        }
    }

    /// Where the demo camera stands.
    pub fn stand(&self) -> Stand {
        self.stand
    }

    fn storeys(&self) -> &'static [Storey] {
        match self.kind {
            ProceduralKind::Jungle => JUNGLE,
            ProceduralKind::Grass => MEADOW,
            ProceduralKind::Terrain => &[],
        }
    }

    /// Collects the plants whose feet stand in the rectangle from `low` to `high` (metres, half open).
    pub fn plants(&self, low: [f32; 2], high: [f32; 2], sites: &mut Vec<Site>) {
        sites.clear();
        self.candidates(low, high, |candidate| {
            let chance = candidate.chance * if candidate.adjustable { self.density } else { 1.0 };
            if candidate.draw < chance {
                sites.push(candidate.site);
            }
        });
    }

    /// Quads to be expected on a rectangle at density 1: those of fixed storeys, and those of adjustable ones.
    pub fn expected_quads(&self, low: [f32; 2], high: [f32; 2]) -> [f64; 2] {
        let mut expected = [0.0; 2];
        self.candidates(low, high, |candidate| {
            let quads = self.mean_quads[candidate.site.species as usize];
            expected[usize::from(candidate.adjustable)] += f64::from(candidate.chance) * quads;
        });
        expected
    }

    fn candidates(&self, low: [f32; 2], high: [f32; 2], mut each: impl FnMut(Candidate)) {
        for (number, storey) in self.storeys().iter().enumerate() {
            let index = |metres: f32| (metres / storey.spacing).floor() as i32;
            // A candidate stays inside its own lattice cell, so these cells hold all of the rectangle's.
            for j in index(low[1])..=index(high[1]) {
                for i in index(low[0])..=index(high[0]) {
                    let seed = combine(combine(combine(self.seed, number as u32), i as u32), j as u32);
                    let x = (i as f32 + unit_f32(combine(seed, 1))) * storey.spacing;
                    let z = (j as f32 + unit_f32(combine(seed, 2))) * storey.spacing;
                    let inside = x >= low[0] && x < high[0] && z >= low[1] && z < high[1];
                    if !inside {
                        continue;
                    }
                    if let Some(candidate) = self.candidate(storey, number as u32, seed, x, z) {
                        each(candidate);
                    }
                }
            }
        }
    }

    fn candidate(&self, storey: &Storey, number: u32, seed: u32, x: f32, z: f32) -> Option<Candidate> {
        let mut share = unit_f32(combine(seed, 3));
        // Patches of one species: neighbours draw alike.
        share = (share + 0.9 * noise(self.seed ^ 0x51ec_1e50, x * 0.21, z * 0.21)).rem_euclid(1.0);
        let total: f32 = storey.species.iter().map(|&(_, weight)| weight).sum();
        let species = storey.species.iter().find(|&&(_, weight)| {
            share -= weight / total;
            share < 0.0
        });
        let species = species.or(storey.species.last())?.0;
        if self.mean_quads[species as usize] > self.plant_quads_max {
            return None;
        }
        let scale = 0.75 + 0.45 * unit_f32(combine(seed, 4));
        let (chance, scale) = match self.kind {
            ProceduralKind::Jungle => self.in_jungle(storey, species, scale, x, z),
            _ => self.in_meadow(species, scale, x, z, storey.chance),
        };
        let patchiness = 1.0 + 0.8 * noise(self.seed.wrapping_add(number), x * 0.16, z * 0.16);
        let chance = (chance * patchiness).clamp(0.0, 1.0);
        let site = Site { species, seed: combine(seed, 5), scale, x, z };
        let keep = chance > 0.0 && !self.blocks_the_camera(&site);
        keep.then(|| Candidate {
            site,
            chance,
            draw: unit_f32(combine(seed, 6)),
            adjustable: storey.adjustable,
        })
    }

    /// Chance and scale in the jungle.
    fn in_jungle(&self, storey: &Storey, species: Species, scale: f32, x: f32, z: f32) -> (f32, f32) {
        let radius = (x * x + z * z).sqrt();
        // The clearing's rim is not a circle.
        let wander = 1.0 + 0.35 * noise(self.seed ^ 0xc1ea_4174, x * 0.13, z * 0.13);
        let rim = self.clearing * wander + storey.setback;
        let forest = smoothstep(rim - 0.6, rim + 1.2, radius);
        let edge = forest * (1.0 - smoothstep(rim + 1.0, rim + 5.0, radius));
        let mut chance =
            storey.chance * (storey.in_clearing * (1.0 - forest) + forest) + storey.at_edge * edge;
        let off_path = (x - path(z)).abs() - species.reach() * 0.35;
        chance *= if species == Litter { 1.0 } else { smoothstep(0.12, 0.55, off_path) };
        let low = matches!(species, Grass | Litter | Rosette | Stone | Log | Mushrooms);
        let scale = if low { scale } else { scale * (0.6 + 0.4 * forest) };
        chance *= match species {
            // Grass wants light, litter trees.
            Grass => 1.15 - 0.75 * forest,
            Litter => 0.25 + 0.75 * forest,
            _ => 1.0,
        };
        (chance, scale)
    }

    /// Chance and scale in the meadow.
    fn in_meadow(&self, species: Species, scale: f32, x: f32, z: f32, chance: f32) -> (f32, f32) {
        let drift = noise(self.seed ^ 0xf10e_4e45, x * 0.11, z * 0.11);
        let chance = match species {
            Flower => chance * (0.8 + 2.2 * drift),
            _ => chance,
        };
        (chance, scale * (1.0 + 0.4 * drift))
    }

    /// Whether a plant stands in the camera, or right before it.
    fn blocks_the_camera(&self, site: &Site) -> bool {
        let Stand { foot, target, eye, .. } = self.stand;
        let clear = |x: f32, z: f32, radius: f32| {
            let (dx, dz) = (site.x - x, site.z - z);
            let away = radius + site.species.reach() * site.scale;
            dx * dx + dz * dz < away * away
        };
        let low = site.species.reach() == 0.0 && eye > 1.3;
        if low {
            return false;
        }
        // The camera itself, and two steps ahead.
        let (dx, dz) = (target[0] - foot[0], target[1] - foot[1]);
        let step = 1.2 / (dx * dx + dz * dz).sqrt().max(1e-3);
        let margin = if self.kind == ProceduralKind::Jungle { 1.5 } else { 0.9 };
        clear(foot[0], foot[1], margin) || clear(foot[0] + dx * step, foot[1] + dz * step, margin * 0.6)
    }
}

/// The path's x at `z`, metres.
fn path(z: f32) -> f32 {
    1.1 * sincos(z * 0.23 + 0.6).0 + 0.5 * sincos(z * 0.61).0 - 0.9
}

/// Where the camera stands in a square of half side `half` with a clearing of radius `clearing`.
fn stand(kind: ProceduralKind, half: f32, clearing: f32) -> Stand {
    match kind {
        ProceduralKind::Jungle => {
            let z = 0.72 * clearing;
            Stand {
                foot: [path(z) + 0.4, z],
                eye: 1.7,
                target: [path(-clearing) * 0.5, -clearing],
                target_height: 2.1_f32.min(0.25 * half),
                fov_degrees: 58.0,
            }
        }
        ProceduralKind::Grass => {
            let reach = half.min(12.0);
            Stand {
                foot: [0.0, 0.6 * reach],
                eye: 1.1,
                target: [0.0, -0.6 * reach],
                target_height: 0.05,
                fov_degrees: 45.0,
            }
        }
        ProceduralKind::Terrain => {
            let reach = 0.9 * half;
            Stand {
                foot: [0.0, reach],
                eye: (0.09 * half).max(1.7),
                target: [0.0, -0.5 * reach],
                target_height: 0.0,
                fov_degrees: 45.0,
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn jungle() -> Scatter {
        Scatter::new(ProceduralKind::Jungle, 9, 30.0, [100.0; Species::ALL.len()])
    }

    /// Catches a plant that is lost or planted twice where two patches meet.
    #[test]
    fn patches_share_the_plants_out() {
        let (scatter, mut sites) = (jungle(), Vec::new());
        scatter.plants([-6.0, 8.0], [6.0, 20.0], &mut sites);
        let whole = sites.len();
        let mut parts = 0;
        for (low, high) in
            [([-6.0, 8.0], [1.5, 20.0]), ([1.5, 8.0], [6.0, 11.25]), ([1.5, 11.25], [6.0, 20.0])]
        {
            scatter.plants(low, high, &mut sites);
            parts += sites.len();
        }
        assert!(whole > 100);
        assert_eq!(whole, parts);
    }

    /// Catches a camera inside a leaf and a clearing with trees in it.
    #[test]
    fn the_camera_stands_free() {
        for seed in 0..20 {
            let scatter = Scatter { seed, ..jungle() };
            let (stand, mut sites) = (scatter.stand(), Vec::new());
            scatter.plants([-12.0; 2], [12.0; 2], &mut sites);
            for site in &sites {
                let distance = (site.x - stand.foot[0]).hypot(site.z - stand.foot[1]);
                let reach = site.species.reach() * site.scale;
                assert!(reach == 0.0 || distance >= 1.5 + reach, "{site:?}");
                let radius = site.x.hypot(site.z);
                assert!(site.species != Giant || radius > 0.5 * scatter.clearing);
            }
        }
    }
}
