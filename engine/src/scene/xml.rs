//! XML text to a small tree whose every name and value knows its place; bounded in depth, size and counts.
//!
//! Names and values are slices of the text, so a place need not be stored: it is where the slice lies. Document type
//! declarations, and with them entities, are refused before anything could expand (XML 1.0, sections 2.8 and 4.4).

use std::path::Path;

use quick_xml::Reader;
use quick_xml::errors::{Error as XmlError, IllFormedError};
use quick_xml::events::attributes::{AttrError, Attributes};
use quick_xml::events::{BytesDecl, Event};

use crate::{Error, ErrorKind, Result};

/// Bytes of a scene file at most. Larger scenes keep their bulk, the matrices, in instance files.
pub const SCENE_BYTES_MAX: usize = 64 << 20;
/// Elements inside one another at most. The grammar needs six.
pub const DEPTH_MAX: usize = 32;
/// Bytes of an attribute's value at most.
pub const VALUE_BYTES_MAX: usize = 1 << 20;
/// Elements of a scene file at most, so that the tree stays below 10 MB.
pub const ELEMENTS_MAX: usize = 1 << 18;
/// Attributes of an element at most. The grammar needs five.
const ATTRIBUTES_MAX: usize = 64;
/// Attributes of a scene file at most, so that the tree stays below 50 MB.
const ALL_ATTRIBUTES_MAX: usize = 1 << 20;

/// A parsed document: elements in document order, each with the attributes that follow its predecessor's.
#[derive(Debug)]
pub(super) struct Document<'a> {
    /// The name in errors, and the base of relative paths.
    pub path: &'a Path,
    text: &'a str,
    pub(super) nodes: Vec<Node<'a>>,
    pub(super) attributes: Vec<Attribute<'a>>,
}

/// An element in the tree.
#[derive(Debug)]
pub(super) struct Node<'a> {
    /// Its name, a slice of the text.
    pub name: &'a str,
    /// Where its attributes end in the document's list; they begin where its predecessor's end.
    pub attributes_end: u32,
    /// The index behind its last descendant.
    pub end: u32,
}

/// An attribute of an element; both are slices of the text.
#[derive(Clone, Copy, Debug)]
pub(super) struct Attribute<'a> {
    /// Its name.
    pub name: &'a str,
    /// Its value as written, with references such as `&amp;` unresolved.
    pub raw: &'a str,
}

impl<'a> Document<'a> {
    /// Parses a whole document.
    ///
    /// # Errors
    /// Ill-formed XML, document type declarations, text, and whatever passes a limit; with line and column.
    pub fn parse(path: &'a Path, text: &'a str) -> Result<Self> {
        let text = text.strip_prefix('\u{feff}').unwrap_or(text);
        let document = Self { path, text, nodes: Vec::new(), attributes: Vec::new() };
        if text.len() > SCENE_BYTES_MAX {
            return Err(too_long(text.len() as u64).at(path));
        }
        document.check_characters()?;
        Walk { document, open: Vec::new() }.run()
    }

    /// Line and column, both from 1 and in characters, of a slice of the text.
    pub fn place(&self, part: &str) -> (u64, u64) {
        let offset = (part.as_ptr() as usize).wrapping_sub(self.text.as_ptr() as usize);
        debug_assert!(offset <= self.text.len(), "only slices of the text have a place in it");
        self.place_of(offset)
    }

    /// Line and column of a byte of the text.
    fn place_of(&self, offset: usize) -> (u64, u64) {
        place_in(self.text.get(..offset).unwrap_or(self.text))
    }

    /// An error at a slice of the text.
    pub fn error(&self, kind: ErrorKind, at: &str, message: impl Into<String>) -> Error {
        let (line, column) = self.place(at);
        Error::new(kind, message).at_text(self.path, line, column)
    }

    /// An error at a byte of the text.
    fn error_at(&self, kind: ErrorKind, offset: usize, message: impl Into<String>) -> Error {
        let (line, column) = self.place_of(offset);
        Error::new(kind, message).at_text(self.path, line, column)
    }

    /// Refuses what XML 1.0 does not count as a character (section 2.2).
    fn check_characters(&self) -> Result<()> {
        let bad =
            |c: char| (c < ' ' && !matches!(c, '\t' | '\n' | '\r')) || matches!(c, '\u{fffe}' | '\u{ffff}');
        match self.text.char_indices().find(|&(_, c)| bad(c)) {
            Some((offset, c)) => Err(self.error_at(
                ErrorKind::Invalid,
                offset,
                format!("character U+{:04X} is not allowed in XML", u32::from(c)),
            )),
            None => Ok(()),
        }
    }
}

/// The line and column behind `before`, the text up to there.
pub(super) fn place_in(before: &str) -> (u64, u64) {
    let line = before.bytes().filter(|&byte| byte == b'\n').count() as u64 + 1;
    let column = before.rsplit('\n').next().unwrap_or("").chars().count() as u64 + 1;
    (line, column)
}

/// The error of a file that is longer than [`SCENE_BYTES_MAX`].
pub(super) fn too_long(bytes: u64) -> Error {
    Error::new(
        ErrorKind::Limit,
        format!("scene file of {bytes} bytes or more, at most {SCENE_BYTES_MAX} are possible"),
    )
    .hint("put matrices into a file: `<instances file=\"...\"/>`")
}

/// The one walk over the document.
struct Walk<'a> {
    document: Document<'a>,
    open: Vec<usize>,
}

impl<'a> Walk<'a> {
    fn run(mut self) -> Result<Document<'a>> {
        let text = self.document.text;
        if text.starts_with('\u{feff}') {
            return Err(self.invalid(0, "byte order mark is there twice"));
        }
        let mut reader = Reader::from_str(text);
        loop {
            let start = reader.buffer_position() as usize;
            let event =
                reader.read_event().map_err(|error| self.syntax(&error, reader.error_position() as usize))?;
            let end = reader.buffer_position() as usize;
            match event {
                Event::Start(_) => self.element(start, end, true)?,
                Event::Empty(_) => self.element(start, end, false)?,
                Event::End(_) => self.close(),
                Event::Text(_) => self.no_text(start, end)?,
                Event::CData(_) => return Err(self.invalid(start, "text is not allowed here")),
                Event::GeneralRef(_) => return Err(self.invalid(start, "text is not allowed here")),
                Event::Decl(decl) => self.declaration(start, &decl)?,
                Event::DocType(_) => return Err(self.no_doctype(start)),
                Event::Comment(_) | Event::PI(_) => {}
                Event::Eof => break,
            }
        }
        self.finish()
    }

    fn invalid(&self, offset: usize, message: impl Into<String>) -> Error {
        self.document.error_at(ErrorKind::Invalid, offset, message)
    }

    fn limit(&self, offset: usize, message: impl Into<String>) -> Error {
        self.document.error_at(ErrorKind::Limit, offset, message)
    }

    /// Adds an element whose tag, angle brackets included, is `start..end`.
    fn element(&mut self, start: usize, end: usize, opens: bool) -> Result<()> {
        if self.open.is_empty() && !self.document.nodes.is_empty() {
            return Err(self.invalid(start, "second root element, expected one"));
        }
        if self.open.len() >= DEPTH_MAX {
            return Err(self.limit(start, format!("elements nest deeper than {DEPTH_MAX}")));
        }
        if self.document.nodes.len() >= ELEMENTS_MAX {
            return Err(self
                .limit(start, format!("more than {ELEMENTS_MAX} elements"))
                .hint("put matrices into a file: `<instances file=\"...\"/>`"));
        }
        let tail = if opens { 1 } else { 2 };
        let tag = self.document.text.get(start + 1..end.saturating_sub(tail)).unwrap_or_default();
        let name = tag.split(is_space).next().unwrap_or_default();
        self.attributes(start + 1, tag, name.len())?;
        let index = self.document.nodes.len();
        self.document.nodes.push(Node {
            name,
            attributes_end: self.document.attributes.len() as u32,
            end: index as u32 + 1,
        });
        if opens {
            self.open.push(index);
        }
        Ok(())
    }

    /// Adds the attributes of a tag that begins at `start`, behind its `<`.
    fn attributes(&mut self, start: usize, tag: &'a str, name_bytes: usize) -> Result<()> {
        for (count, attribute) in Attributes::new(tag, name_bytes).enumerate() {
            let attribute = attribute.map_err(|error| self.attribute_error(start, tag, &error))?;
            let name = attribute.key.0;
            let std::borrow::Cow::Borrowed(raw) = attribute.value else {
                return Err(self.invalid(start, "attribute cannot be read"));
            };
            let document = &self.document;
            let name_offset = name.as_ptr() as usize - tag.as_ptr() as usize;
            if !tag[..name_offset].ends_with(is_space) {
                return Err(document.error(
                    ErrorKind::Invalid,
                    name,
                    "expected a space before the attribute",
                ));
            }
            if let Some(at) = raw.find('<') {
                return Err(document
                    .error(ErrorKind::Invalid, &raw[at..], "`<` is not allowed in a value")
                    .hint("write `&lt;`, or close the value with a quote before"));
            }
            if raw.len() > VALUE_BYTES_MAX {
                let message = format!("value of {} bytes, at most {VALUE_BYTES_MAX} are possible", raw.len());
                return Err(document.error(ErrorKind::Limit, raw, message));
            }
            if count >= ATTRIBUTES_MAX || document.attributes.len() >= ALL_ATTRIBUTES_MAX {
                return Err(document.error(ErrorKind::Limit, name, "too many attributes"));
            }
            self.document.attributes.push(Attribute { name, raw });
        }
        Ok(())
    }

    fn attribute_error(&self, start: usize, tag: &str, error: &AttrError) -> Error {
        match *error {
            AttrError::Duplicated(at, first) => {
                let name = tag
                    .get(at..)
                    .unwrap_or_default()
                    .split(|c| is_space(c) || c == '=')
                    .next()
                    .unwrap_or_default();
                let (line, column) = self.document.place_of(start + first);
                self.invalid(start + at, format!("attribute `{name}` is there twice"))
                    .hint(format!("the first one is at line {line}, column {column}"))
            }
            AttrError::ExpectedEq(at) => self.invalid(start + at, "expected `=` after the attribute's name"),
            AttrError::ExpectedValue(at) => self.invalid(start + at, "expected a quoted value after `=`"),
            AttrError::UnquotedValue(at) => self.invalid(start + at, "expected a quoted value"),
            AttrError::ExpectedQuote(at, _) => self.invalid(start + at, "value's closing quote is missing"),
        }
    }

    fn close(&mut self) {
        if let Some(index) = self.open.pop() {
            self.document.nodes[index].end = self.document.nodes.len() as u32;
        }
    }

    /// Refuses text other than white space.
    fn no_text(&self, start: usize, end: usize) -> Result<()> {
        let text = self.document.text.get(start..end).unwrap_or_default();
        match text.find(|c| !is_space(c)) {
            Some(at) => Err(self.invalid(start + at, "text is not allowed here")),
            None => Ok(()),
        }
    }

    fn no_doctype(&self, offset: usize) -> Error {
        self.document
            .error_at(
                ErrorKind::Unsupported,
                offset,
                "document type declarations are refused, and entities with them",
            )
            .hint("remove `<!DOCTYPE ...>`; scenes have a schema, `docs/scene.xsd`")
    }

    /// Checks `<?xml version="1.0" encoding="UTF-8"?>`.
    fn declaration(&self, offset: usize, decl: &BytesDecl) -> Result<()> {
        if offset != 0 {
            return Err(self.invalid(offset, "XML declaration must come first"));
        }
        let version = decl
            .version()
            .map_err(|error| self.invalid(offset, format!("broken XML declaration: {error}")))?;
        if version != "1.0" {
            let message = format!("XML version `{}` found, `1.0` wanted", version.escape_default());
            return Err(self.document.error_at(ErrorKind::Unsupported, offset, message));
        }
        let encoding = match decl.encoding() {
            None => return Ok(()),
            Some(Ok(encoding)) => encoding,
            Some(Err(error)) => return Err(self.invalid(offset, format!("broken XML declaration: {error}"))),
        };
        if ["utf-8", "us-ascii"].iter().any(|known| encoding.eq_ignore_ascii_case(known)) {
            return Ok(());
        }
        let message = format!("encoding `{}` found, `UTF-8` wanted", encoding.escape_default());
        Err(self.document.error_at(ErrorKind::Unsupported, offset, message).hint("save the file as UTF-8"))
    }

    /// What the pull parser reports, in this house's words.
    fn syntax(&self, error: &XmlError, offset: usize) -> Error {
        let at = self.document.text.get(offset..).unwrap_or_default();
        if at.get(..9).is_some_and(|start| start.eq_ignore_ascii_case("<!DOCTYPE")) {
            return self.no_doctype(offset);
        }
        match error {
            XmlError::IllFormed(IllFormedError::MismatchedEndTag { expected, found }) => self
                .invalid(offset, format!("`</{}>` found, `</{}>` expected", cut(found), cut(expected)))
                .hint(self.opened_hint()),
            XmlError::IllFormed(IllFormedError::UnmatchedEndTag(found)) => {
                self.invalid(offset, format!("`</{}>` closes nothing", cut(found)))
            }
            XmlError::IllFormed(IllFormedError::MissingDoctypeName) => self.no_doctype(offset),
            XmlError::IllFormed(error) => self.invalid(offset, error.to_string()),
            XmlError::Syntax(error) => self.invalid(offset, error.to_string()),
            error => self.invalid(offset, format!("broken XML: {error}")),
        }
    }

    fn opened_hint(&self) -> String {
        let Some(&index) = self.open.last() else { return "nothing is open here".into() };
        let name = self.document.nodes[index].name;
        let (line, column) = self.document.place(name);
        format!("`{}` was opened at line {line}, column {}", cut(name), column - 1)
    }

    fn finish(self) -> Result<Document<'a>> {
        if let Some(&index) = self.open.last() {
            let name = self.document.nodes[index].name;
            let offset = name.as_ptr() as usize - self.document.text.as_ptr() as usize;
            return Err(self.invalid(offset - 1, format!("element `{}` is never closed", cut(name))));
        }
        if self.document.nodes.is_empty() {
            return Err(self.invalid(self.document.text.len(), "expected an element `scene`, found none"));
        }
        Ok(self.document)
    }
}

/// White space as XML has it (section 2.3).
pub(super) fn is_space(c: char) -> bool {
    matches!(c, ' ' | '\t' | '\r' | '\n')
}

/// A value fit for a message: one line, at most 60 characters.
pub(super) fn cut(value: &str) -> String {
    const CHARACTERS_MAX: usize = 60;
    let mut shown: String =
        value.chars().take(CHARACTERS_MAX).map(|c| if c.is_control() { ' ' } else { c }).collect();
    if value.chars().nth(CHARACTERS_MAX).is_some() {
        shown.push('…');
    }
    shown
}

#[cfg(test)]
mod tests {
    use super::*;

    fn parse(text: &str) -> Result<Document<'_>> {
        Document::parse(Path::new("s.xml"), text)
    }

    fn check(text: &str, expected: &str) -> Error {
        let error = parse(text).expect_err(text);
        assert_eq!(error.to_string(), expected, "{text}");
        error
    }

    /// Catches an index or a place that is off: the tree's shape, its attributes and their columns.
    #[test]
    fn the_tree_knows_its_shape_and_places() {
        let text = "\u{feff}<?xml version='1.0' encoding='utf-8'?>\n<a é='ü' x = \"1\"><!-- <no/> --><b y='2'/>\n <c><d/></c></a>\n";
        let document = parse(text).unwrap();
        let names: Vec<_> = document.nodes.iter().map(|node| (node.name, node.end)).collect();
        assert_eq!(names, [("a", 4), ("b", 2), ("c", 4), ("d", 4)]);
        let places: Vec<_> = document
            .attributes
            .iter()
            .map(|a| (a.name, a.raw, document.place(a.name), document.place(a.raw)))
            .collect();
        assert_eq!(
            places,
            [("é", "ü", (2, 4), (2, 7)), ("x", "1", (2, 10), (2, 15)), ("y", "2", (2, 35), (2, 38))]
        );
        assert_eq!(document.nodes.iter().map(|n| n.attributes_end).collect::<Vec<_>>(), [2, 3, 3, 3]);
    }

    /// Catches ill-formed XML that passes, and a wrong place or word in what is said about it.
    #[test]
    fn ill_formed_documents_are_refused() {
        for (text, expected) in [
            ("", "s.xml:1:1: expected an element `scene`, found none"),
            ("<!-- -->\n", "s.xml:2:1: expected an element `scene`, found none"),
            ("<a>\n <b>\n</a>", "s.xml:3:1: `</a>` found, `</b>` expected"),
            ("<a/>\n</b>", "s.xml:2:1: `</b>` closes nothing"),
            ("<a>\n <b x='1'>", "s.xml:2:2: element `b` is never closed"),
            ("<a>\n <b", "s.xml:2:2: tag not closed: `>` not found before end of input"),
            ("<a>\n<!-- ", "s.xml:2:1: comment not closed: `-->` not found before end of input"),
            ("<a/><b/>", "s.xml:1:5: second root element, expected one"),
            ("<a>  text</a>", "s.xml:1:6: text is not allowed here"),
            ("<a/> x", "s.xml:1:6: text is not allowed here"),
            ("<a><![CDATA[]]></a>", "s.xml:1:4: text is not allowed here"),
            ("<a>&lt;</a>", "s.xml:1:4: text is not allowed here"),
            ("<a x='1'  x='2'/>", "s.xml:1:11: attribute `x` is there twice"),
            ("<a x=1/>", "s.xml:1:6: expected a quoted value"),
            ("<a x/>", "s.xml:1:5: expected `=` after the attribute's name"),
            ("<a x=/>", "s.xml:1:6: expected a quoted value after `=`"),
            ("<a x='1'y='2'/>", "s.xml:1:9: expected a space before the attribute"),
            ("<a x='1<2'/>", "s.xml:1:8: `<` is not allowed in a value"),
            ("<a x='\u{1}'/>", "s.xml:1:7: character U+0001 is not allowed in XML"),
            (" <?xml version='1.0'?><a/>", "s.xml:1:2: XML declaration must come first"),
            ("<?xml version='1.1'?><a/>", "s.xml:1:1: XML version `1.1` found, `1.0` wanted"),
            (
                "<?xml version='1.0' encoding='latin1'?><a/>",
                "s.xml:1:1: encoding `latin1` found, `UTF-8` wanted",
            ),
            ("\u{feff}\u{feff}<a/>", "s.xml:1:1: byte order mark is there twice"),
        ] {
            check(text, expected);
        }
        let twice = check("<a\n x='1' x='2'/>", "s.xml:2:8: attribute `x` is there twice");
        assert_eq!(twice.hint_text(), Some("the first one is at line 2, column 2"));
        let opened = check("<a>\n <b>\n</a>", "s.xml:3:1: `</a>` found, `</b>` expected");
        assert_eq!(opened.hint_text(), Some("`b` was opened at line 2, column 2"));
    }

    /// Catches an entity that is expanded: billion laughs and external entities end at the declaration.
    #[test]
    fn document_types_are_refused_unread() {
        let laughs =
            "<!DOCTYPE lolz [<!ENTITY lol \"lol\"><!ENTITY lol2 \"&lol;&lol;&lol;\">]>\n<a>&lol2;</a>";
        for text in [laughs, "<!DOCTYPE a SYSTEM 'file:///etc/passwd'><a/>", "<!doctype a [", "<!DOCTYPE>"] {
            let error = parse(text).expect_err(text);
            assert_eq!(error.kind(), ErrorKind::Unsupported, "{error}");
            assert!(error.message().starts_with("document type declarations are refused"), "{error}");
        }
    }

    /// Catches a limit that is not kept, or that refuses what just fits.
    #[test]
    fn depth_size_and_counts_are_limited() {
        let nested = |depth: usize| "<a>".repeat(depth) + &"</a>".repeat(depth);
        assert!(parse(&nested(DEPTH_MAX)).is_ok());
        assert_eq!(parse(&nested(DEPTH_MAX + 1)).unwrap_err().kind(), ErrorKind::Limit);
        let valued = |bytes: usize| format!("<a x='{}'/>", "v".repeat(bytes));
        assert!(parse(&valued(VALUE_BYTES_MAX)).is_ok());
        assert_eq!(parse(&valued(VALUE_BYTES_MAX + 1)).unwrap_err().kind(), ErrorKind::Limit);
        let many = |count: usize| format!("<a>{}</a>", "<b/>".repeat(count - 1));
        assert!(parse(&many(ELEMENTS_MAX)).is_ok());
        assert_eq!(parse(&many(ELEMENTS_MAX + 1)).unwrap_err().kind(), ErrorKind::Limit);
        let wide =
            |count: usize| format!("<a{}/>", (0..count).map(|i| format!(" x{i}='1'")).collect::<String>());
        assert!(parse(&wide(ATTRIBUTES_MAX)).is_ok());
        assert_eq!(parse(&wide(ATTRIBUTES_MAX + 1)).unwrap_err().kind(), ErrorKind::Limit);
        let long = format!("<a/>{}", " ".repeat(SCENE_BYTES_MAX));
        assert_eq!(parse(&long).unwrap_err().kind(), ErrorKind::Limit);
    }
}
