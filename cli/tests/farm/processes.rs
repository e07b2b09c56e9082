//! Coordinator, workers and commands as processes, ended with the test.

use std::net::TcpListener;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::sync::OnceLock;
use std::time::{Duration, Instant};

use serde_json::Value;
pub use serde_json::json;
use tempfile::TempDir;

/// Time for anything that a test waits for.
const PATIENCE: Duration = Duration::from_secs(120);

const SCENE: &str = r#"<scene version="1" units="m" up="y">
  <shaders>
    <shader name="occlusion" type="sh_occlusion"> <param name="samples" value="512"/> </shader>
  </shaders>
  <geometries>
    <geometry name="hill" occluder="true">
      <stream procedural="terrain" seed="7" micropolygons="24000"/>
      <bakeset name="hill"> <attribute name="sh" shader="occlusion"/> </bakeset>
    </geometry>
    <geometry name="tent" occluder="true"> <stream file="models/tent.obj"/> </geometry>
  </geometries>
</scene>"#;
const TENT: &str = "v -1 0 -1\nv 1 0 -1\nv 0 2 0\nv -1 0 1\nv 1 0 1\nf 1 2 3\nf 4 3 5\nf 1 3 4\n";

/// A farm with a folder of its own.
pub struct Farm {
    folder: TempDir,
    /// The coordinator's port.
    pub port: u16,
    /// What the coordinator is started with besides.
    serve: Vec<String>,
    /// The environment of every process.
    environment: Vec<(&'static str, String)>,
    coordinator: Option<Child>,
    workers: Vec<(String, Option<Child>)>,
}

/// A worker of a farm.
#[derive(Clone, Copy)]
pub struct Worker(usize);

impl Farm {
    /// A coordinator that asks for no tokens, and a scene to submit.
    pub fn start() -> Self {
        Self::start_with(&["--insecure-local"], Vec::new())
    }

    /// A coordinator with more arguments, and an environment for it and everybody else.
    pub fn start_with(serve: &[&str], environment: Vec<(&'static str, String)>) -> Self {
        let folder = tempfile::tempdir().unwrap();
        std::fs::create_dir_all(folder.path().join("scene/models")).unwrap();
        std::fs::write(folder.path().join("scene/scene.xml"), SCENE).unwrap();
        std::fs::write(folder.path().join("scene/models/tent.obj"), TENT).unwrap();
        let port = TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap().port();
        let serve = serve.iter().map(|argument| argument.to_string()).collect();
        let mut farm = Self { folder, port, serve, environment, coordinator: None, workers: Vec::new() };
        farm.start_coordinator();
        farm
    }

    /// A path in the farm's folder.
    pub fn at(&self, name: &str) -> String {
        self.folder.path().join(name).to_str().unwrap().into()
    }

    fn pantaray(&self) -> Command {
        let mut command = Command::new(env!("CARGO_BIN_EXE_pantaray"));
        self.prepare(&mut command);
        command
    }

    /// Gives a command its environment.
    fn prepare(&self, command: &mut Command) {
        let token = self.at("data/admin.token");
        command
            .env("PANTARAY_URL", format!("http://127.0.0.1:{}", self.port))
            .env_remove("PANTARAY_TOKEN_FILE");
        if Path::new(&token).exists() {
            command.env("PANTARAY_TOKEN_FILE", token);
        }
        command.envs(self.environment.iter().map(|(name, value)| (name, value)));
        for name in ["http_proxy", "HTTP_PROXY", "all_proxy", "ALL_PROXY"] {
            command.env_remove(name);
        }
    }

    /// What a process says is kept in a file that a failed test shows.
    fn spawn(&self, mut command: Command, name: &str) -> Child {
        let log = std::fs::File::options().create(true).append(true).open(self.at(&format!("{name}.log")));
        command.env("RUST_LOG", "info").stderr(log.unwrap()).stdout(Stdio::piped()).spawn().unwrap()
    }

    /// Starts the coordinator on what it left, and waits until it listens.
    pub fn start_coordinator(&mut self) {
        let mut command = self.pantaray();
        command.args(["serve", "--data", &self.at("data"), "--lease", "5", "--listen"]);
        command.arg(format!("127.0.0.1:{}", self.port)).args(&self.serve);
        let before = self.times_listening();
        self.coordinator = Some(self.spawn(command, "coordinator"));
        let start = Instant::now();
        // By what it says: another test's coordinator may have had the port a moment ago
        while self.times_listening() == before {
            assert!(start.elapsed() < PATIENCE, "{}", self.logs());
            std::thread::sleep(Duration::from_millis(20));
        }
    }

    /// How often the coordinator has said that it listens.
    fn times_listening(&self) -> usize {
        let log = std::fs::read_to_string(self.at("coordinator.log")).unwrap_or_default();
        log.matches("listening at").count()
    }

    /// Kills the coordinator.
    pub fn kill_coordinator(&mut self) {
        end(self.coordinator.take());
    }

    /// Starts a worker with a cache of its own.
    pub fn worker(&mut self, name: &str) -> Worker {
        self.worker_at(name, &format!("http://127.0.0.1:{}", self.port), &[])
    }

    /// Starts a worker that knows the coordinator by this URL, with more arguments.
    pub fn worker_at(&mut self, name: &str, url: &str, arguments: &[&str]) -> Worker {
        let mut command = self.pantaray();
        self.add_worker(&mut command, name);
        command.args(["--url", url]).args(arguments);
        let child = self.spawn(command, name);
        self.workers.push((name.into(), Some(child)));
        Worker(self.workers.len() - 1)
    }

    /// Starts a worker whose disk takes no file larger than `kilobytes`.
    pub fn cramped_worker(&mut self, name: &str, kilobytes: u32) -> Worker {
        let mut command = Command::new("bash");
        self.prepare(&mut command);
        // Without the trap the signal that comes with the error would end the process
        let script = format!("trap '' XFSZ; ulimit -f {kilobytes}; exec \"$0\" \"$@\"");
        command.args(["-c", &script, env!("CARGO_BIN_EXE_pantaray")]);
        self.add_worker(&mut command, name);
        let child = self.spawn(command, name);
        self.workers.push((name.into(), Some(child)));
        Worker(self.workers.len() - 1)
    }

    fn add_worker(&self, command: &mut Command, name: &str) {
        command.args(["worker", "--json", "--name", name, "--cache", &self.at(name), "--device", "cpu"]);
        command.args(["--threads", "1", "--memory", "256MiB", "--grace", "0"]);
    }

    fn child(&mut self, worker: Worker) -> &mut Option<Child> {
        &mut self.workers[worker.0].1
    }

    /// Kills a worker.
    pub fn kill(&mut self, worker: Worker) {
        end(self.child(worker).take());
    }

    /// Ends the worker of this name.
    pub fn end(&mut self, name: &str) {
        self.workers.iter_mut().filter(|(other, _)| other == name).for_each(|(_, child)| end(child.take()));
    }

    /// Sends a worker a signal.
    pub fn signal(&mut self, worker: Worker, signal: &str) {
        let pid = self.child(worker).as_ref().unwrap().id().to_string();
        let sent = Command::new("kill").args([format!("-{signal}"), pid]).status().unwrap();
        assert!(sent.success());
    }

    /// Waits for a worker's end; what it says it did.
    pub fn join(&mut self, worker: Worker) -> Value {
        let output = self.child(worker).take().unwrap().wait_with_output().unwrap();
        assert!(output.status.success(), "{}", self.logs());
        serde_json::from_slice(&output.stdout).unwrap()
    }

    /// Waits for the end of a worker that must fail; its exit code.
    pub fn join_failed(&mut self, worker: Worker) -> Option<i32> {
        let output = self.child(worker).take().unwrap().wait_with_output().unwrap();
        assert!(!output.status.success(), "{}", self.logs());
        output.status.code()
    }

    /// Runs a command that must succeed; its answer.
    pub fn command(&self, arguments: &[&str]) -> Value {
        let output = self.pantaray().args(arguments).args(["--json", "--quiet"]).output().unwrap();
        let said = String::from_utf8_lossy(&output.stderr);
        assert!(output.status.success(), "{arguments:?}: {said}\n{}", self.logs());
        serde_json::from_slice(&output.stdout).unwrap()
    }

    /// Runs a command that must fail; its exit code and its error.
    pub fn fails(&self, arguments: &[&str]) -> (i32, String) {
        let output = self.pantaray().args(arguments).output().unwrap();
        assert!(!output.status.success(), "{arguments:?}");
        (output.status.code().unwrap(), String::from_utf8_lossy(&output.stderr).into_owned())
    }

    /// Submits the scene with a seed; the job.
    pub fn submit(&self, seed: u32) -> String {
        self.submit_with(seed, &[])
    }

    /// Submits with more arguments.
    pub fn submit_with(&self, seed: u32, arguments: &[&str]) -> String {
        let (scene, seed) = (self.at("scene/scene.xml"), seed.to_string());
        let mut all = vec!["submit", &scene, "--seed", &seed];
        all.extend_from_slice(arguments);
        self.command(&all)["jobs"][0].as_str().unwrap().into()
    }

    /// Waits until `done` batches of a job are baked and others are being baked.
    pub fn until_baking(&self, job: &str, done: i64) {
        let start = Instant::now();
        loop {
            let batches = self.command(&["jobs", job])["batches"].clone();
            let count = |state: &str| batches[state].as_i64().unwrap();
            if count("done") >= done && count("leased") > 0 {
                return;
            }
            let left = count("ready") + count("leased") > 0 || count("done") == 0;
            assert!(left && start.elapsed() < PATIENCE, "{batches}\n{}", self.logs());
            std::thread::sleep(Duration::from_millis(20));
        }
    }

    /// Waits for a job's success.
    pub fn wait(&self, job: &str) {
        let start = Instant::now();
        loop {
            let shown = self.command(&["jobs", job]);
            match shown["state"].as_str().unwrap() {
                "succeeded" => return,
                "failed" | "cancelled" => panic!("{shown}\n{}", self.logs()),
                _ => assert!(start.elapsed() < PATIENCE, "{shown}\n{}", self.logs()),
            }
            std::thread::sleep(Duration::from_millis(100));
        }
    }

    /// Waits for the success of a job that the coordinator may have paused, since the first worker failed at all of it before
    /// there was another.
    pub fn wait_through_pause(&self, job: &str) {
        let start = Instant::now();
        while self.command(&["jobs", job])["state"] != "succeeded" {
            assert!(start.elapsed() < PATIENCE, "{}", self.logs());
            if self.command(&["jobs", job])["waiting"] == "paused" {
                self.command(&["resume", job]);
            }
            std::thread::sleep(Duration::from_millis(100));
        }
    }

    /// Brings a job's stream down.
    pub fn fetch(&self, job: &str) -> (PathBuf, Vec<u8>) {
        let folder = self.at(&format!("fetched-{job}"));
        let manifest = self.command(&["fetch", job, "-o", &folder]);
        assert_eq!(
            (&manifest["incomplete"], &manifest["outputs"][0]["name"]),
            (&json!(false), &json!("hill.mgs"))
        );
        let path = PathBuf::from(folder).join("hill.mgs");
        let bytes = std::fs::read(&path).unwrap();
        (path, bytes)
    }

    /// Compares what a job published with what one process bakes.
    pub fn expect(&self, job: &str, seed: u32) {
        let folder = self.at(&format!("baked-{seed}"));
        let (scene, seed) = (self.at("scene/scene.xml"), seed.to_string());
        self.command(&[
            "bake", &scene, "-o", &folder, "--seed", &seed, "--device", "cpu", "--memory", "256MiB",
        ]);
        let baked = std::fs::read(PathBuf::from(folder).join("hill.mgs")).unwrap();
        assert!(self.fetch(job).1 == baked, "the farm's bytes differ\n{}", self.logs());
    }

    /// Compares what a job with seed 1 published with what one process bakes, once for all tests.
    pub fn expect_same(&self, job: &str) {
        static BAKED: OnceLock<Vec<u8>> = OnceLock::new();
        let baked = BAKED.get_or_init(|| {
            let (scene, folder) = (self.at("scene/scene.xml"), self.at("baked"));
            let options = ["--seed", "1", "--device", "cpu", "--memory", "256MiB"];
            self.command(&[&["bake", &scene, "-o", &folder], &options[..]].concat());
            std::fs::read(PathBuf::from(folder).join("hill.mgs")).unwrap()
        });
        assert!(self.fetch(job).1 == *baked, "the farm's bytes differ\n{}", self.logs());
    }

    /// Waits until a process has said something.
    pub fn until_said(&self, name: &str, words: &str) {
        let start = Instant::now();
        while !self.log(name).contains(words) {
            assert!(start.elapsed() < PATIENCE, "{}", self.logs());
            std::thread::sleep(Duration::from_millis(50));
        }
    }

    /// What a process has said so far.
    pub fn log(&self, name: &str) -> String {
        std::fs::read_to_string(self.at(&format!("{name}.log"))).unwrap_or_default()
    }

    fn logs(&self) -> String {
        let names = self.workers.iter().map(|(name, _)| name.as_str()).chain(["coordinator"]);
        names.map(|name| format!("--- {name}\n{}", self.log(name))).collect()
    }
}

impl Drop for Farm {
    fn drop(&mut self) {
        self.kill_coordinator();
        self.workers.iter_mut().for_each(|(_, child)| end(child.take()));
    }
}

fn end(child: Option<Child>) {
    if let Some(mut child) = child {
        let _ = child.kill();
        let _ = child.wait();
    }
}
