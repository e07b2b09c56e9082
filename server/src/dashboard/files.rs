//! The files of `server/dashboard`, as the program carries them.

/// A file by its path.
macro_rules! files {
    ($($path:literal),* $(,)?) => {
        &[$(($path, include_bytes!(concat!("../../dashboard/", $path)))),*]
    };
}

/// Every file and its path; a test compares them with the folder.
pub const FILES: &[(&str, &[u8])] = files![
    "api.js",
    "app.js",
    "attention.js",
    "dialog.js",
    "dom.js",
    "format.js",
    "icon.svg",
    "index.html",
    "job/actions.js",
    "job/batches.js",
    "job/failures.js",
    "job/figures.js",
    "job/pace.js",
    "job/passes.js",
    "job/strip.js",
    "job/work.js",
    "live.js",
    "pages/audit.js",
    "pages/job.js",
    "pages/jobs.js",
    "pages/limits.js",
    "pages/report.js",
    "pages/sign-in.js",
    "pages/stuck.js",
    "pages/submit.js",
    "pages/tokens.js",
    "pages/viewer.js",
    "pages/workers.js",
    "sha256.js",
    "style/base.css",
    "style/pages.css",
    "style/parts.css",
    "style/viewer.css",
    "submit.js",
    "table.js",
    "traced.js",
    "viewer/camera.js",
    "viewer/hdr.js",
    "viewer/layer.js",
    "viewer/light.js",
    "viewer/panel.js",
    "viewer/preview.js",
    "viewer/renderer.js",
    "viewer/sh.js",
    "viewer/shaders.js",
    "viewer/sources.js",
    "viewer/state.js",
    "words.js",
];
