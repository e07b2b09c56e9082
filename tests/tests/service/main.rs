//! The coordinator over real HTTP on the loopback interface, with real workers where there is work.

mod bakes;
mod browser;
mod garbage;
mod leases;
mod life;
mod people;
mod roles;
mod sessions;

use std::path::Path;
use std::sync::Arc;
use std::time::Duration;

use protocol::Role;
use protocol::admin::TokenRequest;
use protocol::job::JobRequest;
use serde_json::{Value, json};
use server::config::Settings;
use server::coordinator::Coordinator;
use tokio::sync::oneshot;
use worker::client::Client;

/// A scene that bakes in a second.
const SCENE: &str = r#"<scene version="1" units="m" up="y">
  <shaders>
    <shader name="occlusion" type="sh_occlusion"> <param name="samples" value="16"/> </shader>
  </shaders>
  <geometries>
    <geometry name="hill" occluder="true">
      <stream procedural="terrain" seed="7" micropolygons="20000"/>
      <bakeset name="hill"> <attribute name="sh" shader="occlusion"/> </bakeset>
    </geometry>
    <geometry name="tent" occluder="true">
      <stream file="models/tent.obj"/>
      <bakeset name="tent" occluders="tent"> <attribute name="sh" shader="occlusion"/> </bakeset>
    </geometry>
  </geometries>
</scene>"#;
/// A file of it.
const TENT: &str = "v -1 0 -1\nv 1 0 -1\nv 0 2 0\nv -1 0 1\nv 1 0 1\nf 1 2 3\nf 4 3 5\nf 1 3 4\n";

/// A coordinator that serves.
struct Service {
    runtime: tokio::runtime::Runtime,
    coordinator: Arc<Coordinator>,
    url: String,
    end: Option<oneshot::Sender<()>>,
    served: Option<tokio::task::JoinHandle<server::Result<()>>>,
}

impl Service {
    /// Starts one whose objects are below `folder`; its database is a SQLite file there unless another is given.
    fn start(folder: &Path, database: Option<String>) -> Self {
        Self::start_with(folder, |settings| settings.database = database.unwrap_or(settings.database.clone()))
    }

    /// Starts one with other settings than usual.
    fn start_with(folder: &Path, change: impl FnOnce(&mut Settings)) -> Self {
        let runtime = tokio::runtime::Builder::new_multi_thread().worker_threads(2).enable_all().build();
        let runtime = runtime.expect("a runtime");
        let mut settings = Settings::local(folder, "127.0.0.1:0".parse().expect("an address"));
        settings.connections = 8;
        change(&mut settings);
        let (end, ended) = oneshot::channel::<()>();
        let (coordinator, url, served) = runtime.block_on(async {
            let coordinator = Coordinator::open(settings).await.expect("the coordinator opens");
            let listener = tokio::net::TcpListener::bind("127.0.0.1:0").await.expect("a port");
            let url = format!("http://{}", listener.local_addr().expect("an address"));
            let serving = server::http::serve(coordinator.clone(), listener, async {
                // The test's end is an end, too
                let _ = ended.await;
            });
            (coordinator, url, tokio::spawn(serving))
        });
        Self { runtime, coordinator, url, end: Some(end), served: Some(served) }
    }

    /// A new token's secret.
    fn token(&self, role: Role, project: Option<&str>) -> String {
        let request = TokenRequest {
            role,
            project: project.map(str::to_owned),
            label: role.to_string(),
            expires_s: None,
        };
        let made = server::http::make_token(&self.coordinator.store, &request, self.coordinator.now());
        self.runtime.block_on(made).expect("a token").secret
    }

    /// A client with a new token.
    fn client(&self, role: Role) -> Client {
        let token = self.token(role, None);
        Client::new(&self.url, Some(&token), Duration::from_secs(5)).expect("a client")
    }

    /// Asks it to end; when it has.
    fn stop(&mut self) {
        drop(self.end.take());
        if let Some(served) = self.served.take() {
            let result = self.runtime.block_on(served).expect("no panic");
            result.expect("it ends well");
        }
    }

    /// Uploads the scene's file, to the project `default`.
    fn upload(&self, client: &Client) -> String {
        let content = worker::digest::of_bytes(TENT.as_bytes());
        let file = tempfile::NamedTempFile::new().expect("a file");
        std::fs::write(file.path(), TENT).expect("written");
        client.upload(&client.own(&format!("/v1/assets/{}", content.sha256)), file.path()).expect("uploaded");
        content.sha256
    }

    /// A request for the scene.
    fn request(&self, client: &Client) -> JobRequest {
        let files = json!({ "models/tent.obj": self.upload(client) });
        let request = json!({ "name": "camp", "scene": SCENE, "files": files });
        serde_json::from_value(request).expect("a request")
    }
}

impl Drop for Service {
    fn drop(&mut self) {
        drop(self.end.take());
    }
}

/// Runs a test on SQLite, and on PostgreSQL where that is installed.
fn on_both(test: impl Fn(&mut Service, &Path)) {
    let folder = tempfile::tempdir().expect("a folder");
    let mut service = Service::start(folder.path(), None);
    test(&mut service, folder.path());
    service.stop();
    let Some(url) = tests::postgres::shared_database() else {
        eprintln!("skipped: PostgreSQL is not installed");
        return;
    };
    let folder = tempfile::tempdir().expect("a folder");
    let mut service = Service::start(folder.path(), Some(url));
    test(&mut service, folder.path());
    service.stop();
}

/// The status of an answer, and its body as JSON if it is.
fn ask(url: &str, method: &str, token: Option<&str>, body: Option<Value>) -> (u16, Value) {
    let config = ureq::Agent::config_builder().http_status_as_error(false);
    let agent: ureq::Agent = config.timeout_global(Some(Duration::from_secs(10))).build().into();
    let mut request = ureq::http::Request::builder().method(method).uri(url);
    if let Some(token) = token {
        request = request.header("authorization", format!("Bearer {token}"));
    }
    let request = request.header("content-type", "application/json");
    let reply = match body {
        Some(body) => agent.run(request.body(body.to_string()).expect("a request")),
        None => agent.run(request.body(()).expect("a request")),
    };
    let mut reply = reply.expect("an answer");
    let status = reply.status().as_u16();
    let streams = reply.headers().get("content-type").is_some_and(|kind| kind == "text/event-stream");
    let text = if streams { String::new() } else { reply.body_mut().read_to_string().unwrap_or_default() };
    (status, serde_json::from_str(&text).unwrap_or(Value::Null))
}
