//! The dashboard in a real headless Chromium: this side runs the farm and draws what the viewer must show, the scripts in
//! `tests/browser` press its buttons. Where there is no Chromium or no driver for it, these tests say that they are skipped.

use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use engine::relight::{Environment, RelightOptions, Viewpoint, relight};
use engine::scene::Camera;
use engine::stream::file::MgsReader;
use glam::{DMat4, DVec3};
use protocol::Role;
use serde_json::{Value, json};
use worker::run::run;

use super::{SCENE, Service, bakes};

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
        Some(chromium) if modules.join("node_modules/axe-core").is_dir() => Some((chromium, modules)),
        _ if std::env::var_os("PANTARAY_NEEDS_BROWSER").is_some() => {
            panic!("there is no Chromium, or not what drives it in target/browser")
        }
        _ => {
            eprintln!(
                "skipped: no Chromium, or not what drives it in target/browser; tests/run installs both"
            );
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

/// Draws the hill under a light that is turned, as the viewer must show it.
fn draw(baked: &Path, light: Environment, rotation_degrees: f64, target: &Path) {
    let mut options = RelightOptions::new(light);
    options.viewpoint = Viewpoint::Camera(camera());
    options.rotation_degrees = rotation_degrees;
    options.background = false;
    options.attribute = Some("sh".into());
    let mut stream = MgsReader::open(baked).unwrap();
    relight(&mut stream, &options, &mut |_| {}).unwrap().save(target).unwrap();
}

/// Writes a Radiance map: a blue night with a broad orange glow in its middle.
fn write_map(path: &Path) {
    let mut bytes = b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 16 +X 32\n".to_vec();
    for y in 0..16_i32 {
        for x in 0..32_i32 {
            let is_glow = (x - 16).abs() < 5 && (y - 5).abs() < 4;
            bytes.extend(if is_glow { [240, 140, 40, 132] } else { [10, 20, 60, 128] });
        }
    }
    std::fs::write(path, bytes).unwrap();
}

/// What the viewer must show of the bake in `folder`, under lights that turn, and under a map that is dropped on it.
fn pictures(folder: &Path) -> (Vec<Value>, Value) {
    let baked = folder.join("baked/hill.mgs");
    let lights = [("sky", 0.0), ("sky", 180.0), ("overcast", 0.0)];
    let of_light = |(at, &(env, rotation)): (usize, &(&str, f64))| {
        let picture = folder.join(format!("{at}.png"));
        draw(&baked, Environment::open(env).unwrap(), rotation, &picture);
        json!({ "env": env, "rotation": rotation, "picture": picture })
    };
    let (map, picture) = (folder.join("glow.hdr"), folder.join("glow.png"));
    write_map(&map);
    draw(&baked, Environment::open(map.to_str().unwrap()).unwrap(), 90.0, &picture);
    let dropped = json!({ "map": map, "rotation": 90, "picture": picture });
    (lights.iter().enumerate().map(of_light).collect(), dropped)
}

/// A worker's process; it ends with this, if nobody has ended it before.
struct Process(std::process::Child);

impl Process {
    fn start(service: &Service, name: &str, folder: &Path) -> Self {
        let child = Command::new(env!("CARGO_BIN_EXE_worker"))
            .env("PANTARAY_URL", &service.url)
            .env("PANTARAY_TOKEN", service.token(Role::Worker, None))
            .env("PANTARAY_WORKER", name)
            .env("PANTARAY_CACHE", folder.join(name))
            .spawn();
        Self(child.expect("a worker"))
    }
}

impl Drop for Process {
    fn drop(&mut self) {
        // One that is dead already cannot be killed
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

/// Catches a dashboard on which a scene cannot be submitted, watched, seen and relit as `relight` does it; a worker's death
/// that is not told, or whose batches are lost; a button that a viewer should not have; text that cannot be read; and any
/// error in the browser.
#[test]
fn a_scene_is_baked_and_relit_in_the_browser() {
    let Some(browser) = browser() else { return };
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    // Some 30 batches: enough for a worker to die among them
    let scene = SCENE.replace("value=\"16\"", "value=\"512\"").replace("20000", "60000");
    let coefficients = r#"<attribute name="sh" shader="occlusion"/>"#;
    let error = r#"<attribute name="sh_error" shader="occlusion" output="error"/>"#;
    let scene = scene.replace(coefficients, &format!("{coefficients} {error}"));
    bakes::quiet_bake_of(folder, &scene);
    let (lit, dropped) = pictures(folder);
    let service = Service::start_with(folder, |settings| settings.lease_ttl_ms = 4_000);
    let roles = [Role::Viewer, Role::Submitter, Role::Admin];
    let tokens: serde_json::Map<String, Value> =
        roles.iter().map(|&role| (role.to_string(), service.token(role, None).into())).collect();
    let victim = Process::start(&service, "w1", folder);
    let relief = folder.join("relief");
    let plan = json!({
        "tokens": tokens,
        "files": [folder.join("scene.xml"), folder.join("models/tent.obj")],
        "victim": victim.0.id(),
        "relief": relief,
        "view": { "eye": EYE.to_array(), "at": [0, 0, 0], "fov": 40, "size": SIZE, "pictures": lit, "dropped": dropped },
    });
    let stop = AtomicBool::new(false);
    std::thread::scope(|scope| {
        let options = bakes::options(service.client(Role::Worker), "w2", folder);
        // The second worker comes when the script asks for it
        let worker = scope.spawn(|| {
            while !relief.exists() && !stop.load(Ordering::SeqCst) {
                std::thread::sleep(Duration::from_millis(50));
            }
            run(&{ options }, &stop)
        });
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

/// Catches a list of jobs that holds all of them in the page, loses some, or sorts only what it has; and a job of a million
/// batches whose page takes them one by one.
#[test]
fn ten_thousand_jobs_and_a_million_batches_stay_fluid() {
    let Some(browser) = browser() else { return };
    let folder = tempfile::tempdir().unwrap();
    let service = Service::start(folder.path(), None);
    service.runtime.block_on(async {
        // Jobs that have ended: nothing of them runs, and one in a thousand has failed
        let jobs = r#"INSERT INTO job (id, project, name, state, reason, priority, request, request_sha256, submitted_by, created_at,
                started_at, ended_at)
            WITH RECURSIVE n (i) AS (SELECT 0 UNION ALL SELECT i + 1 FROM n WHERE i < 9999)
            SELECT 'm' || SUBSTR('0000' || i, -5), 'default', 'shot ' || SUBSTR('0000' || i, -5), CASE WHEN i % 1000 = 234 THEN 5 ELSE 4 END,
                '', i % 100, '{"name":"x","scene":""}', '', 'tester', 1700000000000 + i * 1000, 1700000000000 + i * 1000, 1700000060000 + i * 1000 FROM n"#;
        // One that runs: 1,000 segments of 1,000 batches, of which two thirds are done, some run and some have failed
        let large = r#"INSERT INTO job (id, project, name, state, failed_max, priority, request, request_sha256, submitted_by, created_at, started_at)
                VALUES ('million', 'default', 'a million batches', 2, 100, 50, '{"name":"x","scene":""}', '', 'tester', 1700020000000, 1700020000000);
            INSERT INTO pass (id, job_id, kind, name, state, task, batch_count, created_count, segment_size, created_at)
                VALUES (1, 'million', 3, 'forest', 2, '{"kind":"bake","job":"million","settings":{},"set":"forest"}', 1000000, 1000000, 1000, 1700020000000);
            INSERT INTO segment (pass_id, seg, lo, hi, n_ready, n_leased, n_done, n_failed)
                WITH RECURSIVE n (i) AS (SELECT 0 UNION ALL SELECT i + 1 FROM n WHERE i < 999)
                SELECT 1, i, 1000 * i, 1000 * i + 1000, CASE WHEN i < 660 THEN 0 WHEN i < 680 THEN 400 ELSE 1000 END,
                    CASE WHEN i >= 660 AND i < 680 THEN 64 ELSE 0 END, CASE WHEN i = 300 THEN 995 WHEN i < 660 THEN 1000 WHEN i < 680 THEN 536 ELSE 0 END,
                    CASE WHEN i = 300 THEN 5 ELSE 0 END FROM n;
            INSERT INTO batch (pass_id, seq, seg, state, fence, tries)
                WITH RECURSIVE n (i) AS (SELECT 0 UNION ALL SELECT i + 1 FROM n WHERE i < 999999)
                SELECT 1, i, i / 1000, CASE WHEN i / 1000 = 300 AND i % 1000 >= 995 THEN 3 WHEN i / 1000 < 660 THEN 2
                    WHEN i / 1000 < 680 THEN CASE WHEN i % 1000 < 536 THEN 2 WHEN i % 1000 < 600 THEN 1 ELSE 0 END ELSE 0 END,
                    CASE WHEN i / 1000 < 680 THEN 1 ELSE 0 END, 1 FROM n"#;
        for sql in [jobs, large] {
            service.coordinator.store.driver().script(sql).await.unwrap();
        }
    });
    let plan = json!({ "many": 10_001, "tokens": { "submitter": service.token(Role::Submitter, None) } });
    play(&service, folder.path(), &plan, &browser);
}
