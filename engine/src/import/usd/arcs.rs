//! Inherits and specializes of all layers read so far. The library follows them by calling itself, in a circle until its stack
//! ends: layers that would lead there are refused.

use std::collections::{HashMap, HashSet};
use std::io::Cursor;

use openusd::sdf::{AbstractData, SpecType, Value};
use openusd::{usda, usdc};

/// Classes of classes at most.
const DEPTH_MAX: usize = 256;

/// Which prims inherit or specialize which, by path; whichever layer says so.
#[derive(Debug, Default)]
pub(super) struct ClassArcs {
    targets: HashMap<String, Vec<String>>,
}

impl ClassArcs {
    /// Adds what a layer says. Refuses it when classes then form a circle, or a chain that is too long.
    pub fn add_layer(&mut self, bytes: &[u8]) -> Result<(), String> {
        // What cannot be read is for the library to refuse
        let found = if bytes.starts_with(b"PXR-USDC") {
            usdc::CrateData::open(Cursor::new(bytes), true).map(|data| arcs(&data)).unwrap_or_default()
        } else {
            let mentions = |word: &[u8]| bytes.windows(word.len()).any(|window| window == word);
            let text =
                std::str::from_utf8(bytes).ok().filter(|_| mentions(b"inherits") || mentions(b"specializes"));
            text.and_then(|text| usda::parse(text).ok()).map(|data| arcs(&data)).unwrap_or_default()
        };
        self.add(found)
    }

    fn add(&mut self, found: Vec<(String, String)>) -> Result<(), String> {
        let sources: Vec<String> = found.iter().map(|(source, _)| source.clone()).collect();
        for (source, target) in found {
            let targets = self.targets.entry(source).or_default();
            if !targets.contains(&target) {
                targets.push(target);
            }
        }
        let mut done = HashSet::new();
        sources.iter().try_for_each(|source| self.follow(source, &mut done))
    }

    /// What the library looks at for a prim: its own classes and its parent's.
    fn next(&self, path: &str) -> Vec<&str> {
        let parent = path.rsplit_once('/').map_or("", |(parent, _)| parent);
        let targets = [path, parent].into_iter().filter_map(|path| self.targets.get(path));
        targets.flatten().map(String::as_str).collect()
    }

    /// Follows all classes of a prim but those that are `done`.
    fn follow<'a>(&'a self, first: &'a str, done: &mut HashSet<&'a str>) -> Result<(), String> {
        if done.contains(first) {
            return Ok(());
        }
        let mut way = vec![(first, self.next(first))];
        while let Some((path, open)) = way.last_mut() {
            let Some(next) = open.pop() else {
                done.insert(path);
                way.pop();
                continue;
            };
            if let Some(at) = way.iter().position(|(path, _)| *path == next) {
                let circle: Vec<&str> = way[at..].iter().take(8).map(|(path, _)| *path).collect();
                return Err(format!("prims that inherit each other in a circle: `{}`", circle.join("`, `")));
            }
            if way.len() > DEPTH_MAX {
                return Err(format!("`{first}` has classes of classes, more than {DEPTH_MAX} deep"));
            }
            if !done.contains(next) {
                way.push((next, self.next(next)));
            }
        }
        Ok(())
    }
}

/// Every prim of a layer that names a class, and the class.
fn arcs(data: &dyn AbstractData) -> Vec<(String, String)> {
    let mut found = Vec::new();
    for path in data.spec_paths() {
        if !matches!(data.spec_type(&path), Some(SpecType::Prim | SpecType::Variant)) {
            continue;
        }
        for field in ["inheritPaths", "specializes"] {
            let Ok(Some(value)) = data.try_field(&path, field) else { continue };
            let Value::PathListOp(list) = value.as_ref() else { continue };
            let source = path.strip_all_variant_selections();
            for target in list.flatten() {
                let target = source.make_absolute(&target).strip_all_variant_selections();
                found.push((source.as_str().to_owned(), target.as_str().to_owned()));
            }
        }
    }
    found
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Catches circles that are missed, through layers, parents and variants, and classes that are taken for one.
    #[test]
    fn circles_of_classes_are_found() {
        let add = |layers: &[&str]| {
            let mut arcs = ClassArcs::default();
            layers.iter().try_for_each(|layer| arcs.add_layer(format!("#usda 1.0\n{layer}").as_bytes()))
        };
        let pair = ["class \"A\" (inherits = </B>) {}\n", "class \"B\" (specializes = </A>) {}\n"];
        assert!(add(&[&pair.concat()]).unwrap_err().contains("`/A`"));
        assert!(add(&pair).is_err() && add(&pair[..1]).is_ok());
        assert!(add(&["class \"A\" (inherits = </A>) {}"]).is_err());
        let mut binary = Cursor::new(Vec::new());
        let data = usda::parse(&format!("#usda 1.0\n{}", pair.concat())).unwrap();
        usdc::CrateWriter::write(&data, &mut binary).unwrap();
        assert!(ClassArcs::default().add_layer(binary.get_ref()).is_err());
        let parents = "class \"A\" (inherits = </C/d>) { def \"b\" {} }\nclass \"C\" (inherits = </A/b>) { def \"d\" {} }";
        assert!(add(&[parents]).is_err());
        let variant = "def \"A\" (prepend variantSets = \"v\" variants = {string v = \"x\"}) {
            variantSet \"v\" = { \"x\" (inherits = </A>) {} } }";
        assert!(add(&[variant]).is_err());
        let diamond = "class \"A\" (inherits = [</B>, </C>]) {}\nclass \"B\" (inherits = </D>) {}
            class \"C\" (inherits = </D>) {}\nclass \"D\" {}\ndef \"m\" (inherits = </A>) { def \"n\" (inherits = </A>) {} }";
        assert_eq!(add(&[diamond]), Ok(()));
        let chain = |n: usize| {
            (0..n).map(|i| format!("class \"A{i}\" (inherits = </A{}>) {{}}\n", i + 1)).collect::<String>()
        };
        assert!(add(&[&chain(100)]).is_ok() && add(&[&chain(1000)]).is_err());
    }
}
