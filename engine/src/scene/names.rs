//! Names of one kind of thing: what they may look like, where each was declared, and what a reference means.

use std::collections::BTreeMap;

use super::element::Value;
use super::xml::cut;
use crate::stream::schema::names as standard;
use crate::{ErrorKind, Result};

/// Characters of a name at most.
const NAME_MAX: usize = 64;

/// Attributes that streams have themselves: a bake cannot add them.
const RESERVED: [&str; 10] = [
    "P",
    standard::NORMAL,
    standard::RADIUS,
    standard::OPACITY,
    standard::ALBEDO,
    standard::RADIANCE,
    standard::ID,
    standard::INSTANCE,
    standard::BAKED,
    standard::POINT,
];

/// The names of one kind of thing, each with the value that declared it.
///
/// The value is kept as a slice of the document: to find its line takes a pass over the text, which only an error is
/// worth.
pub(super) struct Names<'d> {
    what: &'static str,
    declared: BTreeMap<String, &'d str>,
    as_key: fn(&str) -> String,
}

impl<'d> Names<'d> {
    /// No names yet, of things called `what`.
    pub fn new(what: &'static str) -> Self {
        Self { what, declared: BTreeMap::new(), as_key: str::to_owned }
    }

    /// The same, of things that become files: names that differ in case alone would be one file on some systems.
    pub fn of_files(what: &'static str) -> Self {
        Self { as_key: str::to_ascii_lowercase, ..Self::new(what) }
    }

    /// Declares a name.
    ///
    /// # Errors
    /// When it cannot be a name, or is there already: then the hint says where.
    pub fn declare(&mut self, value: &Value<'d>) -> Result<String> {
        let name = value.text();
        let legal = |c: char| c.is_ascii_alphanumeric() || "_.-".contains(c);
        if name.is_empty()
            || name.len() > NAME_MAX
            || !name.chars().all(legal)
            || name.starts_with(['.', '-'])
        {
            let message = format!(
                "`{}` cannot name a {}, expected 1 to {NAME_MAX} of `A-Z a-z 0-9 _ . -`, the first no `.` or `-`",
                cut(name),
                self.what
            );
            return Err(value.error(ErrorKind::Invalid, message));
        }
        self.declare_once(value)
    }

    /// All names, in order.
    pub fn all(&self) -> impl Iterator<Item = &str> {
        self.declared.keys().map(String::as_str)
    }

    /// Declares the name of an attribute that a bake adds to a stream.
    ///
    /// # Errors
    /// As [`declare`](Self::declare), and when the name is one of a standard attribute.
    pub fn declare_attribute(&mut self, value: &Value<'d>) -> Result<String> {
        let name = value.text();
        let legal = |c: char| c.is_ascii_alphanumeric() || "_.:-".contains(c);
        if name.is_empty() || name.len() > NAME_MAX || !name.chars().all(legal) {
            let message = format!(
                "`{}` cannot name an attribute, expected 1 to {NAME_MAX} of `A-Z a-z 0-9 _ . : -`",
                cut(name)
            );
            return Err(value.error(ErrorKind::Invalid, message));
        }
        if RESERVED.contains(&name) {
            let message = format!("`{name}` is a standard attribute of streams, expected another name");
            return Err(value.error(ErrorKind::Invalid, message));
        }
        self.declare_once(value)
    }

    /// Declares a name of whatever looks.
    pub fn declare_once(&mut self, value: &Value<'d>) -> Result<String> {
        let name = value.text();
        if let Some(first) = self.declared.insert((self.as_key)(name), value.raw()) {
            let (line, column) = value.place_of(first);
            return Err(value
                .error(ErrorKind::Invalid, format!("duplicate {} name `{}`", self.what, cut(name)))
                .hint(format!("the first one is at line {line}, column {column}")));
        }
        Ok(name.to_owned())
    }

    /// The name that a value refers to.
    ///
    /// # Errors
    /// When nothing has that name; the hint is the nearest that something has.
    pub fn resolve(&self, value: &Value<'_>) -> Result<String> {
        match self.declared.contains_key(value.text()) {
            true => Ok(value.text().to_owned()),
            false => Err(value.unknown(self.what, self.declared.keys().map(String::as_str))),
        }
    }

    /// The value that declared a name.
    pub fn declaration(&self, name: &str) -> Option<&'d str> {
        self.declared.get(name).copied()
    }
}
