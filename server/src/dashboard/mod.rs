//! The dashboard: pages for people, from files that the program carries. They are plain ES modules and talk to the same
//! operations as everybody else; nothing is built, and nothing is fetched from elsewhere.

mod files;

use axum::Router;
use axum::extract::Path;
use axum::http::{HeaderMap, HeaderName, HeaderValue, StatusCode, header};
use axum::response::{IntoResponse, Response};
use axum::routing::get;

use self::files::FILES;
use crate::storage::sha256;
use crate::{Error, Result};

/// Pages; the script that one file loads knows what each shows.
const PAGES: [&str; 12] = [
    "/",
    "/jobs",
    "/jobs/{id}",
    "/jobs/{id}/bake",
    "/jobs/{id}/report",
    "/submit",
    "/workers",
    "/stuck",
    "/limits",
    "/audit",
    "/tokens",
    "/sign-in",
];

/// What every answer says: scripts, styles and pictures are ours alone, nothing stands inline, nobody frames us.
const HEADERS: [(HeaderName, &str); 5] = [
    (
        header::CONTENT_SECURITY_POLICY,
        "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' blob:; connect-src 'self'; \
         worker-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'",
    ),
    (header::X_CONTENT_TYPE_OPTIONS, "nosniff"),
    (header::X_FRAME_OPTIONS, "DENY"),
    (header::REFERRER_POLICY, "no-referrer"),
    // A browser asks each time, and is told when it has what there is
    (header::CACHE_CONTROL, "no-cache"),
];

/// The pages and their files. Everybody may have them: they know nothing.
pub fn router<S: Clone + Send + Sync + 'static>() -> Router<S> {
    let page = async |headers: HeaderMap| file("index.html", &headers);
    let one = async |Path(path): Path<String>, headers: HeaderMap| file(&path, &headers);
    let router = Router::new().route("/dashboard/{*path}", get(one));
    PAGES.iter().fold(router, |router, path| router.route(path, get(page)))
}

fn file(path: &str, asked: &HeaderMap) -> Result<Response> {
    let found = FILES.iter().find(|(name, _)| *name == path);
    let (_, bytes) = found.ok_or_else(|| Error::not_found("file", path))?;
    let kind = match path.rsplit('.').next() {
        Some("html") => "text/html; charset=utf-8",
        Some("js") => "text/javascript; charset=utf-8",
        Some("css") => "text/css; charset=utf-8",
        _ => "image/svg+xml",
    };
    let etag = format!("\"{}\"", &sha256(bytes)[..32]);
    let known = asked.get(header::IF_NONE_MATCH).is_some_and(|tag| tag.as_bytes() == etag.as_bytes());
    let mut response = match known {
        true => StatusCode::NOT_MODIFIED.into_response(),
        false => ([(header::CONTENT_TYPE, kind)], *bytes).into_response(),
    };
    let headers = response.headers_mut();
    headers.extend(HEADERS.map(|(name, value)| (name, HeaderValue::from_static(value))));
    if let Ok(etag) = HeaderValue::from_str(&etag) {
        headers.insert(header::ETAG, etag);
    }
    Ok(response)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Every file below a folder, by its path from there.
    fn below(folder: &std::path::Path, prefix: &str, found: &mut Vec<String>) {
        for entry in std::fs::read_dir(folder).unwrap() {
            let entry = entry.unwrap();
            let name = format!("{prefix}{}", entry.file_name().to_str().unwrap());
            match entry.file_type().unwrap().is_dir() {
                true => below(&entry.path(), &format!("{name}/"), found),
                false => found.push(name),
            }
        }
    }

    /// Catches a file that was written and is not carried.
    #[test]
    fn every_file_is_carried() {
        let mut found = Vec::new();
        below(std::path::Path::new(concat!(env!("CARGO_MANIFEST_DIR"), "/dashboard")), "", &mut found);
        found.sort();
        let mut carried: Vec<String> = FILES.iter().map(|(name, _)| (*name).into()).collect();
        carried.sort();
        assert_eq!(carried, found);
    }

    /// Catches script or style that stands inline, which the policy would refuse, and anything fetched from elsewhere.
    #[test]
    fn nothing_is_inline_or_foreign() {
        for (name, bytes) in FILES {
            let text = std::str::from_utf8(bytes).unwrap();
            // The name of SVG's vocabulary is no address
            let text = text.replace("http://www.w3.org/2000/svg", "");
            for foreign in ["http://", "https://", "//cdn"] {
                assert!(!text.contains(foreign), "{name} names `{foreign}`");
            }
            if name.ends_with(".html") {
                for inline in ["<script>", "<style", " style=", " onclick", " onload", "javascript:"] {
                    assert!(!text.contains(inline), "{name} has `{inline}`");
                }
            }
            for unsafe_word in ["innerHTML", "outerHTML", "insertAdjacentHTML", "document.write", "eval("] {
                assert!(!text.contains(unsafe_word), "{name} has `{unsafe_word}`: text must stay text");
            }
        }
    }

    /// Catches a page without its policy, and a file that is sent again to who has it.
    #[test]
    fn files_have_their_headers() {
        let mut asked = HeaderMap::new();
        let page = file("index.html", &asked).unwrap();
        assert_eq!(page.status(), StatusCode::OK);
        for (name, _) in HEADERS {
            assert!(page.headers().contains_key(&name), "{name}");
        }
        asked.insert(header::IF_NONE_MATCH, page.headers()[header::ETAG].clone());
        assert_eq!(file("index.html", &asked).unwrap().status(), StatusCode::NOT_MODIFIED);
        assert!(file("../Cargo.toml", &asked).is_err());
    }
}
