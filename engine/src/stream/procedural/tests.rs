//! Tests of whole streams.

use xxhash_rust::xxh3::Xxh3;

use super::*;
use crate::stream::schema::names;

fn parameters(kind: ProceduralKind, seed: u64, micropolygons: u64) -> Procedural {
    Procedural { kind, seed, micropolygons }
}

fn stream(kind: ProceduralKind, seed: u64, micropolygons: u64) -> ProceduralStream {
    ProceduralStream::new(&parameters(kind, seed, micropolygons), 1.0, UpAxis::Y).unwrap()
}

const KINDS: [ProceduralKind; 3] = [ProceduralKind::Jungle, ProceduralKind::Grass, ProceduralKind::Terrain];

/// Prints mean quads per species.
#[test]
#[ignore]
fn print_species() {
    for (species, mean) in plant::Species::ALL.iter().zip(extent::mean_quads(ProceduralKind::Jungle, 1)) {
        eprintln!("{species:?} {mean}");
    }
}
