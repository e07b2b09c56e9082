//! Geometries: their streams, their copies, and the bake sets they carry.

use std::collections::BTreeSet;
use std::path::Path;

use super::element::{Element, Value};
use super::files::Files;
use super::names::Names;
use super::parse::limited;
use super::{
    BakeAttribute, BakeSet, Dice, Edge, ErrorKind, Geometry, Instances, Procedural, ProceduralKind, Result,
    StreamSource,
};
use crate::stream::schema::ATTRIBUTES_MAX;

/// Geometries of a scene at most.
pub const GEOMETRIES_MAX: usize = 65_536;
/// Bake sets of a scene at most.
pub const BAKE_SETS_MAX: usize = 65_536;
/// Matrices in a scene file at most. They stay in memory, 14 MB of them: a forest belongs into an instance file, which
/// is streamed.
pub const INLINE_INSTANCES_MAX: usize = 100_000;
/// Names in the `occluders` of all bake sets at most.
const OCCLUDER_NAMES_MAX: usize = 1_000_000;
/// Micropolygons of a procedural stream at most.
const MICROPOLYGONS_MAX: u64 = 1_000_000_000_000;

/// The filters the grammar declares (paper, section 4.2).
pub(super) const FILTERS: [&str; 5] =
    ["backface", "frustum", "occlusion", "camera_decimation", "feature_decimation"];

/// Reads geometries once cameras, shaders and the geometries' own names are known.
pub(super) struct Geometries<'a, 'd> {
    /// How paths become files.
    pub files: Files<'a>,
    /// Declared cameras.
    pub cameras: &'a Names<'d>,
    /// Declared shaders.
    pub shaders: &'a Names<'d>,
    /// Declared geometries.
    pub geometries: Names<'d>,
    /// The geometries that occlude.
    pub occluders: BTreeSet<String>,
    bake_sets: Names<'d>,
    bake_set_count: usize,
    inline_instances: usize,
    occluder_names: usize,
}

impl<'a, 'd> Geometries<'a, 'd> {
    /// Declares the geometries of a scene, wherever they are used later.
    pub fn declare(
        elements: &[Element<'d>],
        files: Files<'a>,
        cameras: &'a Names<'d>,
        shaders: &'a Names<'d>,
    ) -> Result<Self> {
        let mut declared = Self {
            files,
            cameras,
            shaders,
            geometries: Names::new("geometry"),
            occluders: BTreeSet::new(),
            bake_sets: Names::of_files("bake set"),
            bake_set_count: 0,
            inline_instances: 0,
            occluder_names: 0,
        };
        for (count, element) in elements.iter().enumerate() {
            limited(*element, count, GEOMETRIES_MAX, "geometries")?;
            let children = ["stream", "instance", "instances", "displacement", "bakeset"];
            element.expect_only(&["name", "occluder"], &children)?;
            let name = declared.geometries.declare(&element.required("name")?)?;
            if is_occluder(*element)? {
                declared.occluders.insert(name);
            }
        }
        Ok(declared)
    }

    /// `<geometry name="" occluder="">` with streams, instances and bake sets.
    pub fn geometry(&mut self, element: Element<'d>) -> Result<Geometry> {
        let mut geometry = Geometry {
            name: element.required("name")?.text().to_owned(),
            occluder: is_occluder(element)?,
            streams: Vec::new(),
            instances: Vec::new(),
            bake_sets: Vec::new(),
        };
        for child in element.children() {
            match child.name() {
                "stream" => geometry.streams.push(self.stream(child)?),
                "instance" => geometry.instances.push(self.instance(child)?),
                "instances" => geometry.instances.push(self.instance_file(child)?),
                "bakeset" => geometry.bake_sets.push(self.bake_set(child)?),
                _ => return Err(self.displacement(child)),
            }
        }
        let name = &geometry.name;
        if geometry.streams.is_empty() {
            let message = format!("geometry `{name}` has no stream, expected an element `stream` in it");
            return Err(element.error(ErrorKind::Invalid, message));
        }
        if !geometry.occluder && geometry.bake_sets.is_empty() {
            let message = format!("geometry `{name}` is neither an occluder nor has it a bake set");
            return Err(element
                .error(ErrorKind::Invalid, message)
                .hint("add `occluder=\"true\"`, or take it out"));
        }
        Ok(geometry)
    }

    /// `<stream file=""/>` or `<stream procedural="" seed="" micropolygons=""/>`
    fn stream(&self, element: Element<'_>) -> Result<StreamSource> {
        match (element.optional("file")?, element.optional("procedural")?) {
            (Some(file), None) => {
                element.expect_only(&["file", "dice"], &[])?;
                let path = self.files.stream(&file)?;
                let dice = element.optional("dice")?.map(|dice| self.dice(&dice, &path)).transpose()?;
                Ok(StreamSource::File(path, dice))
            }
            (None, Some(kind)) => {
                element.expect_only(&["procedural", "seed", "micropolygons"], &[])?;
                procedural(element, &kind).map(StreamSource::Procedural)
            }
            (None, None) => {
                element.expect_only(&["file", "procedural", "seed", "micropolygons"], &[])?;
                let message = "attribute `file` or `procedural` of `stream` is missing";
                Err(element.error(ErrorKind::Invalid, message))
            }
            (Some(_), Some(kind)) => Err(kind
                .error(ErrorKind::Invalid, "stream has both `file` and `procedural`, expected one of them")),
        }
    }

    /// How a stream is to be diced.
    fn dice(&self, value: &Value<'_>, path: &Path) -> Result<Dice> {
        if path.extension().is_some_and(|extension| extension.eq_ignore_ascii_case("mgs")) {
            let message = "a stream of microgrids is diced already";
            return Err(value.error(ErrorKind::Invalid, message).hint("dice it when it is imported"));
        }
        let dice = Dice::parse(value.text()).map_err(|error| {
            let placed = value.error(error.kind(), error.message());
            error.hint_text().into_iter().fold(placed, |placed, hint| placed.hint(hint))
        })?;
        if let Some(Edge::Camera { name, .. }) = &dice.edge
            && !self.cameras.all().any(|known| known == name)
        {
            return Err(value.unknown_word(
                value.text().find(name.as_str()).unwrap_or(0),
                name,
                "camera",
                self.cameras.all(),
            ));
        }
        Ok(dice)
    }

    /// `<instance matrix=""/>`
    fn instance(&mut self, element: Element<'_>) -> Result<Instances> {
        element.expect_only(&["matrix"], &[])?;
        limited(element, self.inline_instances, INLINE_INSTANCES_MAX, "matrices in a scene file")
            .map_err(|error| error.hint("put them into a file: `<instances file=\"...\"/>`"))?;
        self.inline_instances += 1;
        element.required("matrix")?.matrix().map(Instances::Matrix)
    }

    /// `<instances file=""/>`
    fn instance_file(&self, element: Element<'_>) -> Result<Instances> {
        element.expect_only(&["file"], &[])?;
        self.files.instances(&element.required("file")?).map(Instances::File)
    }

    /// `<displacement shader="" bound=""/>`: in the grammar, not in this version.
    fn displacement(&self, element: Element<'_>) -> crate::Error {
        let checked = || {
            element.expect_only(&["shader", "bound"], &[])?;
            self.shaders.resolve(&element.required("shader")?)?;
            element.required("bound")?.real("a number from 0 to 1e12", |bound| (0.0..=1e12).contains(&bound))
        };
        match checked() {
            Ok(_) => element.error(ErrorKind::Unsupported, "displacement is not supported yet"),
            Err(error) => error,
        }
    }

    /// `<filter type="" camera=""/>`: in the grammar, not in this version.
    fn filter(&self, element: Element<'_>) -> crate::Error {
        let checked = || {
            element.expect_only(&["type", "camera"], &[])?;
            let kind = element.required("type")?;
            if !FILTERS.contains(&kind.text()) {
                return Err(kind.unknown("filter type", FILTERS));
            }
            element.optional("camera")?.map_or(Ok(String::new()), |camera| self.cameras.resolve(&camera))
        };
        match checked() {
            Ok(_) => element.error(ErrorKind::Unsupported, "filters are not supported yet"),
            Err(error) => error,
        }
    }

    /// `<bakeset name="" occluders=""> <attribute name="" shader=""/>... </bakeset>`
    fn bake_set(&mut self, element: Element<'d>) -> Result<BakeSet> {
        element.expect_only(&["name", "occluders"], &["filter", "attribute"])?;
        limited(element, self.bake_set_count, BAKE_SETS_MAX, "bake sets")?;
        self.bake_set_count += 1;
        let name = self.bake_sets.declare(&element.required("name")?)?;
        let occluders =
            element.optional("occluders")?.map_or(Ok(Vec::new()), |list| self.occluders(&list))?;
        if let Some(filter) = element.children_named("filter").next() {
            return Err(self.filter(filter));
        }
        let mut attributes = Vec::new();
        let mut names = Names::new("attribute");
        for child in element.children_named("attribute") {
            limited(child, attributes.len(), ATTRIBUTES_MAX, "attributes in a bake set")?;
            child.expect_only(&["name", "shader"], &[])?;
            let name = names.declare_attribute(&child.required("name")?)?;
            attributes
                .push(BakeAttribute { name, shader: self.shaders.resolve(&child.required("shader")?)? });
        }
        if attributes.is_empty() {
            let message =
                format!("bake set `{name}` has no attributes, expected an element `attribute` in it");
            return Err(element.error(ErrorKind::Invalid, message));
        }
        Ok(BakeSet { name, occluders, attributes })
    }

    /// The geometries that a bake set sees, by name.
    fn occluders(&mut self, list: &Value<'_>) -> Result<Vec<String>> {
        let mut names = Vec::new();
        let mut seen = BTreeSet::new();
        for (offset, name) in list.words() {
            self.check_occluder(list, offset, name)?;
            if !seen.insert(name) {
                return Err(list.error_at(
                    offset,
                    ErrorKind::Invalid,
                    format!("occluder `{name}` is there twice"),
                ));
            }
            if self.occluder_names >= OCCLUDER_NAMES_MAX {
                let message = format!("more than {OCCLUDER_NAMES_MAX} names of occluders");
                return Err(list.error_at(offset, ErrorKind::Limit, message));
            }
            self.occluder_names += 1;
            names.push(name.to_owned());
        }
        if names.is_empty() {
            return Err(list
                .error(ErrorKind::Invalid, "list of occluders is empty, expected names of geometries")
                .hint("a bake set without `occluders` sees all"));
        }
        Ok(names)
    }

    fn check_occluder(&self, list: &Value<'_>, offset: usize, name: &str) -> Result<()> {
        if self.occluders.contains(name) {
            return Ok(());
        }
        Err(match self.geometries.declaration(name) {
            Some(declaration) => {
                let (line, column) = list.place_of(declaration);
                list.error_at(offset, ErrorKind::Invalid, format!("geometry `{name}` is no occluder"))
                    .hint(format!("add `occluder=\"true\"` to it, at line {line}, column {column}"))
            }
            None => list.unknown_word(offset, name, "occluder", self.occluders.iter().map(String::as_str)),
        })
    }
}

fn is_occluder(element: Element<'_>) -> Result<bool> {
    element.optional("occluder")?.map_or(Ok(false), |value| value.flag())
}

fn procedural(element: Element<'_>, kind: &Value<'_>) -> Result<Procedural> {
    let kinds = [
        ("jungle", ProceduralKind::Jungle),
        ("grass", ProceduralKind::Grass),
        ("terrain", ProceduralKind::Terrain),
    ];
    Ok(Procedural {
        kind: kind.choice("procedural stream", &kinds)?,
        seed: element.optional("seed")?.map_or(Ok(0), |seed| seed.whole(0..=u64::MAX))?,
        micropolygons: element.required("micropolygons")?.whole(1..=MICROPOLYGONS_MAX)?,
    })
}
