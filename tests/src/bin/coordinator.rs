//! A coordinator for the tests that kill it: as `pantaray serve`, with points at which it ends itself. Unlike that, it takes
//! its arguments in pairs, all of them.

use std::collections::HashMap;
use std::path::{Path, PathBuf};

use protocol::Role;
use protocol::admin::TokenRequest;
use server::config::Settings;
use server::coordinator::Coordinator;

#[tokio::main(worker_threads = 2)]
async fn main() {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let given: HashMap<&str, &str> =
        arguments.chunks_exact(2).map(|pair| (pair[0].as_str(), pair[1].as_str())).collect();
    let data = PathBuf::from(given["--data"]);
    let mut settings = Settings::local(&data, given["--listen"].parse().expect("an address"));
    settings.database = given["--database"].into();
    settings.storage = given["--storage"].into();
    settings.connections = 8;
    settings.lease_ttl_ms = given["--lease"].parse::<i64>().expect("seconds") * 1_000;
    let listen = settings.listen;
    let coordinator = Coordinator::open(settings).await.expect("the coordinator opens");
    if !coordinator.store.has_tokens().await.expect("an answer") {
        make_token(&coordinator, &data).await;
    }
    let listener = tokio::net::TcpListener::bind(listen).await.expect("the port is free");
    server::http::serve(coordinator, listener, std::future::pending()).await.expect("it serves");
}

async fn make_token(coordinator: &Coordinator, data: &Path) {
    let (project, expires_s) = (None, None);
    let request = TokenRequest { role: Role::Admin, project, label: "first".into(), expires_s };
    let made = server::http::make_token(&coordinator.store, &request, coordinator.now()).await;
    std::fs::write(data.join("admin.token"), made.expect("a token").secret).expect("written");
}
