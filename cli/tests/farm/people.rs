//! What administrators do from the command line, on a farm that asks for tokens; and logs that programs read.

use serde_json::Value;

use super::processes::{Farm, json};

/// Catches a ticket that works twice or for another name, a change of a project that drops what it does not name, a worker that
/// is locked and works, and a job that is submitted again with other settings than were asked for.
#[test]
fn a_farm_is_run_from_the_command_line() {
    let mut farm = Farm::start_with(&[], Vec::new());
    let url = format!("http://127.0.0.1:{}", farm.port);
    let (ticket, token) = (farm.at("room.ticket"), farm.at("render17.token"));
    farm.command(&["ticket", "--label", "room=3", "-o", &ticket]);
    farm.command(&["enrol", "--ticket-file", &ticket, "--name", "render17", "-o", &token]);
    let other = farm.at("other.token");
    let (code, error) = farm.fails(&["enrol", "--ticket-file", &ticket, "--name", "render18", "-o", &other]);
    assert!(code == 1 && error.contains("not valid"), "{error}");
    let stranger = farm.worker_at("stranger", &url, &["--token-file", &token]);
    assert_eq!(farm.join_failed(stranger), Some(1));

    // What is not named stays
    farm.command(&["project", "set", "film", "--share", "200", "--running-max", "3", "--outputs-days", "90"]);
    farm.command(&["project", "set", "film", "--retention-days", "30"]);
    let film = |list: Value| list.as_array().unwrap().iter().find(|p| p["name"] == "film").unwrap().clone();
    let project = film(farm.command(&["project", "list"]));
    let wanted =
        json!({ "name": "film", "share": 200, "running_max": 3, "retention_days": 30, "outputs_days": 90 });
    assert_eq!(project, wanted);
    farm.command(&["project", "set", "film", "--running-max", "none"]);
    assert_eq!(film(farm.command(&["project", "list"]))["running_max"], Value::Null);

    // A look makes no job
    let scene = farm.at("scene/scene.xml");
    let estimate = farm.command(&["submit", &scene, "--project", "film", "--dry-run"]);
    assert!(estimate["sets"][0]["name"] == "hill" && estimate["points"].as_u64() > Some(0), "{estimate}");
    assert_eq!(farm.command(&["jobs"])["jobs"], json!([]));
    let job = farm.submit_with(9, &["--project", "film", "--paused", "--running-max", "2"]);
    let changed = farm.command(&["reprioritise", &job, "--priority", "80", "--comment", "hurry"]);
    assert_eq!((&changed["priority"], &changed["comment"]), (&json!(80), &json!("hurry")));

    // A locked worker does nothing
    let arguments = ["--token-file", token.as_str()];
    farm.worker_at("render17", &url, &arguments);
    farm.until_said("render17", "registered");
    farm.command(&["workers", "render17", "--lock"]);
    farm.command(&["resume", &job]);
    std::thread::sleep(std::time::Duration::from_secs(1));
    let worker = farm.command(&["workers"])[0].clone();
    assert_eq!((&worker["state"], &worker["labels"]), (&json!("locked"), &json!(["device=cpu", "room=3"])));
    assert_eq!(farm.command(&["jobs", &job])["batches"]["done"], 0);
    assert_eq!(film(farm.command(&["limits"]))["jobs"], 1);
    farm.command(&["workers", "render17", "--unlock"]);
    farm.wait(&job);

    let settings = json!({ "seed": 10 }).to_string();
    let again = farm.command(&["resubmit", &job, "--name", "again", "--settings", &settings]);
    let again = again["jobs"][0].as_str().unwrap();
    farm.wait(again);
    farm.expect(again, 10);
    farm.command(&["workers", "render17", "--drain"]);
    assert_eq!(farm.command(&["workers"])[0]["state"], "draining");
    let page = farm.command(&["audit", "--limit", "2"]);
    let actions: Vec<&str> =
        page["entries"].as_array().unwrap().iter().filter_map(|entry| entry["action"].as_str()).collect();
    assert_eq!(actions, ["POST /v1/workers/render17/drain", &format!("POST /v1/jobs/{job}/resubmit")]);
}

/// Catches a look at a schema that makes one, and a schema that is not made.
#[test]
fn a_schema_is_made_once() {
    let folder = tempfile::tempdir().unwrap();
    let data = folder.path().join("new");
    let migrate = |arguments: &[&str]| {
        let mut command = std::process::Command::new(env!("CARGO_BIN_EXE_pantaray"));
        command
            .args(["migrate", "--json", "--data"])
            .arg(&data)
            .args(arguments)
            .env_remove("PANTARAY_DATABASE");
        let output = command.output().unwrap();
        assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
        serde_json::from_slice::<Value>(&output.stdout).unwrap()
    };
    assert_eq!(migrate(&["--dry-run"])["found"], Value::Null);
    assert!(!data.exists());
    assert_eq!(migrate(&[])["changed"], true);
    let made = migrate(&["--dry-run"]);
    assert_eq!((&made["found"], &made["changed"]), (&made["wanted"], &json!(false)));
}

/// Catches a line that no program can read, and lines that do not say which request, job, pass, batch and claim they are about.
#[test]
fn logs_are_read_by_programs() {
    let environment = vec![("PANTARAY_LOG_FORMAT", "json".into())];
    let mut farm = Farm::start_with(&["--insecure-local"], environment);
    let worker = farm.worker("first");
    let job = farm.submit_with(11, &["--max-points", "4k"]);
    farm.wait(&job);
    // One job fails, and says so with the batch and its claim
    std::fs::write(farm.at("scene/models/tent.obj"), "v 0 0\n").unwrap();
    let broken = farm.submit_with(12, &[]);
    farm.until_said("coordinator", "a batch failed");
    farm.signal(worker, "TERM");
    farm.join(worker);
    let lines = |name: &str| -> Vec<Value> {
        let read = |line: &str| serde_json::from_str(line).unwrap_or_else(|_| panic!("{name}: {line}"));
        farm.log(name).lines().map(read).collect()
    };
    let within = |line: &Value, name: &str| -> Option<Value> {
        line["spans"].as_array()?.iter().find(|span| span["name"] == name).cloned()
    };
    let coordinator = lines("coordinator");
    let failed = coordinator.iter().find(|line| line["job"] == broken && line["level"] == "WARN").unwrap();
    assert!(
        failed["pass"].is_i64() && failed["batch"] == 0 && failed["fence"].as_i64() > Some(0),
        "{failed}"
    );
    assert_eq!(within(failed, "request").unwrap()["request_id"].as_str().unwrap().len(), 16);
    let claims: Vec<Value> = lines("first").iter().filter_map(|line| within(line, "claim")).collect();
    assert!(claims.iter().any(|claim| claim["job"] == job && claim["kind"] == "bake"), "{claims:?}");
    let first = lines("first");
    let error = first.iter().find(|line| line["level"] == "ERROR").unwrap();
    assert!(error["batch"] == 0 && within(error, "claim").unwrap()["job"] == broken, "{error}");
}
