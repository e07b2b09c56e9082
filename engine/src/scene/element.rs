//! Typed access to the tree: what an element must, may and cannot have, with errors that name place and remedy.

use std::borrow::Cow;
use std::fmt::Display;
use std::ops::RangeInclusive;

use glam::DMat4;
use quick_xml::escape::{EscapeError, unescape};

use super::matrix;
use super::xml::{Attribute, Document, cut};
use crate::error::nearest;
use crate::{Error, ErrorKind, Result};

/// An element of a document.
#[derive(Clone, Copy)]
pub(super) struct Element<'d> {
    document: &'d Document<'d>,
    index: usize,
}

impl<'d> Element<'d> {
    /// The root of a document. A parsed document always has one.
    pub fn root(document: &'d Document<'d>) -> Self {
        Self { document, index: 0 }
    }

    /// Its name.
    pub fn name(self) -> &'d str {
        self.document.nodes[self.index].name
    }

    /// Its children in order.
    pub fn children(self) -> impl Iterator<Item = Self> {
        let end = self.document.nodes[self.index].end as usize;
        let mut next = self.index + 1;
        std::iter::from_fn(move || {
            let child = (next < end).then_some(Self { document: self.document, index: next })?;
            next = self.document.nodes[next].end as usize;
            Some(child)
        })
    }

    /// Its children of one name.
    pub fn children_named(self, name: &str) -> impl Iterator<Item = Self> {
        self.children().filter(move |child| child.name() == name)
    }

    fn attributes(self) -> &'d [Attribute<'d>] {
        let end = |index: usize| self.document.nodes[index].attributes_end as usize;
        let start = self.index.checked_sub(1).map_or(0, end);
        &self.document.attributes[start..end(self.index)]
    }

    /// Line and column of its `<`.
    pub fn place(self) -> (u64, u64) {
        let (line, column) = self.document.place(self.name());
        (line, column - 1)
    }

    /// An error at its `<`.
    pub fn error(self, kind: ErrorKind, message: impl Into<String>) -> Error {
        let (line, column) = self.place();
        Error::new(kind, message).at_text(self.document.path, line, column)
    }

    /// Refuses every attribute and child that is not of the given names.
    pub fn expect_only(self, attributes: &[&str], children: &[&str]) -> Result<()> {
        let name = cut(self.name());
        for attribute in self.attributes() {
            if !attributes.contains(&attribute.name) {
                let message = format!("unknown attribute `{}` of `{name}`", cut(attribute.name));
                let error =
                    self.document.error(ErrorKind::Invalid, attribute.name, expected(message, attributes));
                return Err(did_you_mean(error, attribute.name, attributes));
            }
        }
        for child in self.children() {
            if !children.contains(&child.name()) {
                let message = format!("unknown element `{}` in `{name}`", cut(child.name()));
                let error = child.error(ErrorKind::Invalid, expected(message, children));
                return Err(did_you_mean(error, child.name(), children));
            }
        }
        Ok(())
    }

    /// An attribute's value, if the attribute is there.
    pub fn optional(self, name: &str) -> Result<Option<Value<'d>>> {
        match self.attributes().iter().find(|attribute| attribute.name == name) {
            Some(&attribute) => Value::new(self.document, attribute).map(Some),
            None => Ok(None),
        }
    }

    /// The value of an attribute that must be there.
    pub fn required(self, name: &str) -> Result<Value<'d>> {
        self.optional(name)?.ok_or_else(|| {
            self.error(ErrorKind::Invalid, format!("attribute `{name}` of `{}` is missing", self.name()))
                .hint(format!("add `{name}=\"...\"`"))
        })
    }
}

/// An attribute's value, which knows its place.
pub(super) struct Value<'d> {
    document: &'d Document<'d>,
    attribute: Attribute<'d>,
    text: Cow<'d, str>,
}

impl<'d> Value<'d> {
    /// Resolves the references of a value: the five predefined entities and characters by number.
    fn new(document: &'d Document<'d>, attribute: Attribute<'d>) -> Result<Self> {
        match unescape(attribute.raw) {
            Ok(text) => Ok(Self { document, attribute, text }),
            Err(error) => {
                let at = match &error {
                    EscapeError::UnrecognizedEntity(range, _) => range.start - 1,
                    EscapeError::UnterminatedEntity(range) => range.start,
                    _ => 0,
                };
                let at = attribute.raw.get(at..).unwrap_or(attribute.raw);
                let message = format!("broken reference: {error}");
                Err(document
                    .error(ErrorKind::Invalid, at, message)
                    .hint("only `&amp;`, `&lt;`, `&gt;`, `&quot;`, `&apos;` and `&#NUMBER;` are known; write `&` as `&amp;`"))
            }
        }
    }

    /// The value, references resolved.
    pub fn text(&self) -> &str {
        &self.text
    }

    /// The value as written: a slice of the document.
    pub fn raw(&self) -> &'d str {
        self.attribute.raw
    }

    /// Line and column of another slice of the same document.
    pub fn place_of(&self, part: &str) -> (u64, u64) {
        self.document.place(part)
    }

    /// An error at its first character.
    pub fn error(&self, kind: ErrorKind, message: impl Into<String>) -> Error {
        self.error_at(0, kind, message)
    }

    /// An error at a byte of [`text`](Self::text); at its start if references moved the bytes.
    pub fn error_at(&self, offset: usize, kind: ErrorKind, message: impl Into<String>) -> Error {
        let raw = self.attribute.raw;
        let at = match self.text {
            Cow::Borrowed(_) => raw.get(offset..).unwrap_or(raw),
            Cow::Owned(_) => raw,
        };
        self.document.error(kind, at, message)
    }

    /// The words of a list, each with its offset.
    pub fn words(&self) -> impl Iterator<Item = (usize, &str)> {
        let start = self.text.as_ptr() as usize;
        self.text.split_ascii_whitespace().map(move |word| (word.as_ptr() as usize - start, word))
    }

    /// The error of a value that is not among `known`, with the nearest of them as hint.
    pub fn unknown<'k>(&self, what: &str, known: impl IntoIterator<Item = &'k str>) -> Error {
        self.unknown_word(0, &self.text, what, known)
    }

    /// The same of one word of a list.
    pub fn unknown_word<'k>(
        &self,
        offset: usize,
        word: &str,
        what: &str,
        known: impl IntoIterator<Item = &'k str>,
    ) -> Error {
        let known: Vec<&str> = known.into_iter().collect();
        let message = expected(format!("unknown {what} `{}`", cut(word)), &known);
        did_you_mean(self.error_at(offset, ErrorKind::Invalid, message), word, &known)
    }

    /// What one of several words means.
    pub fn choice<T: Copy>(&self, what: &str, choices: &[(&str, T)]) -> Result<T> {
        match choices.iter().find(|(word, _)| *word == self.text) {
            Some(&(_, meaning)) => Ok(meaning),
            None => Err(self.unknown(what, choices.iter().map(|&(word, _)| word))),
        }
    }

    /// `true` or `false`.
    pub fn flag(&self) -> Result<bool> {
        self.choice("truth value", &[("true", true), ("false", false)])
    }

    /// A whole number within a range.
    pub fn whole(&self, range: RangeInclusive<u64>) -> Result<u64> {
        let number: Result<u64, _> = self.text.trim().parse();
        let expected = || format!("expected a whole number from {} to {}", range.start(), range.end());
        match number {
            Ok(number) if range.contains(&number) => Ok(number),
            Ok(_) => Err(self.out_of_range(expected())),
            Err(_) if self.text.trim().parse::<i128>().is_ok() => Err(self.out_of_range(expected())),
            Err(_) => {
                let message = format!("`{}` is not a whole number, {}", cut(&self.text), expected());
                Err(self.error(ErrorKind::Invalid, message))
            }
        }
    }

    /// A finite number that passes a test; `expected` says which one does.
    pub fn real(&self, expected: &str, valid: impl Fn(f64) -> bool) -> Result<f64> {
        match self.text.trim().parse::<f64>() {
            Ok(number) if number.is_finite() && valid(number) => Ok(number),
            Ok(number) if number.is_finite() => Err(self.out_of_range(format_args!("expected {expected}"))),
            _ => {
                let message = format!("`{}` is not a finite number, expected {expected}", cut(&self.text));
                Err(self.error(ErrorKind::Invalid, message))
            }
        }
    }

    fn out_of_range(&self, expected: impl Display) -> Error {
        self.error(ErrorKind::Invalid, format!("`{}` is out of range, {expected}", cut(&self.text)))
    }

    /// A transform of 16 numbers.
    pub fn matrix(&self) -> Result<DMat4> {
        matrix::parse(&self.text).map_err(|fault| {
            let error = self.error_at(fault.offset, ErrorKind::Invalid, &*fault.message);
            match fault.hint {
                Some(hint) => error.hint(hint),
                None => error,
            }
        })
    }
}

/// Appends what was expected to a message; of many names the first few.
fn expected(message: String, names: &[&str]) -> String {
    const NAMES_MAX: usize = 10;
    let list = names.iter().take(NAMES_MAX).map(|name| format!("`{name}`")).collect::<Vec<_>>().join(", ");
    match names.len() {
        0 => format!("{message}, expected none"),
        1 => format!("{message}, expected {list}"),
        2..=NAMES_MAX => format!("{message}, expected one of {list}"),
        count => format!("{message}, expected one of {list} and {} more", count - NAMES_MAX),
    }
}

/// Adds the nearest of the valid names as hint, if one is near.
fn did_you_mean(error: Error, name: &str, names: &[&str]) -> Error {
    match nearest(name, names.iter().copied()) {
        Some(near) if !name.is_empty() => error.hint(format!("did you mean `{near}`?")),
        _ => error,
    }
}
