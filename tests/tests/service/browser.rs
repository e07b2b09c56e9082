//! The dashboard in a real headless Chromium: this side runs the farm and draws what the viewer must show, the scripts in
//! `tests/browser` press its buttons. Where there is no Chromium or no driver for it, these tests say that they are skipped.

use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::atomic::{AtomicBool, Ordering};

use engine::relight::{Environment, RelightOptions, Viewpoint, relight};
use engine::scene::Camera;
use engine::stream::file::MgsReader;
use glam::{DMat4, DVec3};
use protocol::Role;
use serde_json::{Value, json};
use worker::run::run;

use super::{Service, bakes};

/// Width and height of the pictures that are compared.
const SIZE: [u32; 2] = [480, 320];
/// Where they are taken from, in the scene's units.
const EYE: DVec3 = DVec3::new(45.0, 38.0, 58.0);

/// Chromium, and the folder of what drives it; none where either is missing.
fn browser() -> Option<(PathBuf, PathBuf)> {
    let modules = Path::new(env!("CARGO_MANIFEST_DIR")).join("../target/browser");
    let named = std::env::var_os("PANTARAY_CHROMIUM").map(PathBuf::from);
    let usual = ["/usr/bin/chromium", "/usr/bin/chromium-browser", "/usr/bin/google-chrome"];
    let chromium = named.into_iter().chain(usual.map(PathBuf::from)).find(|path| path.exists());
    match chromium {
        Some(chromium) if modules.join("node_modules/playwright-core").is_dir() => Some((chromium, modules)),
        _ if std::env::var_os("PANTARAY_NEEDS_BROWSER").is_some() => {
            panic!("there is no Chromium or no playwright-core in target/browser")
        }
        _ => {
            eprintln!("skipped: no Chromium, or no playwright-core in target/browser; tests/run installs it");
            None
        }
    }
}

/// Runs the scripts with a plan, and shows what they said.
fn play(service: &Service, folder: &Path, plan: &Value, browser: &(PathBuf, PathBuf)) {
    let path = folder.join("plan.json");
    std::fs::write(&path, plan.to_string()).unwrap();
    let here = Path::new(env!("CARGO_MANIFEST_DIR"));
    let output = Command::new("node")
        .arg(here.join("browser/main.mjs"))
        .env("PANTARAY_URL", &service.url)
        .env("PANTARAY_CHROMIUM", &browser.0)
        .env("PANTARAY_BROWSER_MODULES", &browser.1)
        .env("PANTARAY_PICTURES", browser.1.join("pictures"))
        .env("PANTARAY_PLAN", &path)
        .output()
        .expect("node runs");
    let said = |bytes: &[u8]| String::from_utf8_lossy(bytes).into_owned();
    println!("{}", said(&output.stdout));
    assert!(output.status.success(), "{}\n{}", said(&output.stdout), said(&output.stderr));
}

/// The camera at [`EYE`] that looks at the origin.
fn camera() -> Camera {
    let back = EYE.normalize();
    let right = DVec3::Y.cross(back).normalize();
    let columns = [right.extend(0.0), back.cross(right).extend(0.0), back.extend(0.0), EYE.extend(1.0)];
    let [x, y, z, w] = columns;
    let world_from_camera = DMat4::from_cols(x, y, z, w);
    Camera { name: "eye".into(), fov_degrees: 40.0, resolution: SIZE, world_from_camera }
}

/// Draws the hill under a sky that is turned, as the viewer must show it.
fn draw(baked: &Path, sky: &str, rotation_degrees: f64, target: &Path) {
    let mut options = RelightOptions::new(Environment::open(sky).unwrap());
    options.viewpoint = Viewpoint::Camera(camera());
    options.rotation_degrees = rotation_degrees;
    options.background = false;
    options.attribute = Some("sh".into());
    let mut stream = MgsReader::open(baked).unwrap();
    relight(&mut stream, &options, &mut |_| {}).unwrap().save(target).unwrap();
}

/// Catches a dashboard on which a scene cannot be submitted, watched, seen and relit as `relight` does it; a button that a
/// viewer should not have; and any error in the browser.
#[test]
fn a_scene_is_baked_and_relit_in_the_browser() {
    let Some(browser) = browser() else { return };
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    bakes::quiet_bake(folder);
    let lights = [("sky", 0.0), ("sky", 180.0), ("overcast", 0.0)];
    let pictures: Vec<Value> = lights
        .iter()
        .enumerate()
        .map(|(at, &(env, rotation))| {
            let picture = folder.join(format!("{at}.png"));
            draw(&folder.join("baked/hill.mgs"), env, rotation, &picture);
            json!({ "env": env, "rotation": rotation, "picture": picture })
        })
        .collect();
    let service = Service::start(folder, None);
    let roles = [Role::Viewer, Role::Submitter, Role::Admin];
    let tokens: serde_json::Map<String, Value> =
        roles.iter().map(|&role| (role.to_string(), service.token(role, None).into())).collect();
    let plan = json!({
        "tokens": tokens,
        "files": [folder.join("scene.xml"), folder.join("models/tent.obj")],
        "view": { "eye": EYE.to_array(), "at": [0, 0, 0], "fov": 40, "size": SIZE, "pictures": pictures },
    });
    let stop = AtomicBool::new(false);
    std::thread::scope(|scope| {
        let options = bakes::options(service.client(Role::Worker), "w1", folder);
        let worker = scope.spawn(|| run(&{ options }, &stop));
        let played = std::panic::catch_unwind(std::panic::AssertUnwindSafe(|| {
            play(&service, folder, &plan, &browser);
        }));
        stop.store(true, Ordering::SeqCst);
        worker.join().unwrap().unwrap();
        if let Err(panic) = played {
            std::panic::resume_unwind(panic);
        }
    });
}

/// Catches a list of jobs that holds all of them in the page, loses some, or sorts only what it has.
#[test]
fn ten_thousand_jobs_stay_fluid() {
    let Some(browser) = browser() else { return };
    let folder = tempfile::tempdir().unwrap();
    let service = Service::start(folder.path(), None);
    service.runtime.block_on(async {
        // Jobs that have ended: nothing of them runs, and one in a thousand has failed
        let sql = r#"INSERT INTO job (id, project, name, state, reason, priority, request, request_sha256, submitted_by, created_at,
                started_at, ended_at)
            WITH RECURSIVE n (i) AS (SELECT 0 UNION ALL SELECT i + 1 FROM n WHERE i < 9999)
            SELECT 'm' || SUBSTR('0000' || i, -5), 'default', 'shot ' || SUBSTR('0000' || i, -5), CASE WHEN i % 1000 = 234 THEN 5 ELSE 4 END,
                '', i % 100, '{"name":"x","scene":""}', '', 'tester', 1700000000000 + i * 1000, 1700000000000 + i * 1000, 1700000060000 + i * 1000 FROM n"#;
        service.coordinator.store.driver().script(sql).await.unwrap();
    });
    let plan = json!({ "many": 10_000, "tokens": { "submitter": service.token(Role::Submitter, None) } });
    play(&service, folder.path(), &plan, &browser);
}
