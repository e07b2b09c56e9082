//! Tokens, tickets, workers' names, assets.

use protocol::Role;
use protocol::admin::TokenDetail;
use server::db::access::Token;

use crate::{Queue, on_both, registration};

on_both! {
    /// Catches a revoked token that still counts, and a ticket that is used more often than it may.
    tokens_and_tickets_end
    /// Catches a worker that takes over another's name while that is alive.
    live_names_belong_to_their_token
    /// Catches access to another project's upload by knowing its hash.
    assets_belong_to_projects
}

async fn tokens_and_tickets_end(queue: Queue) {
    let detail = TokenDetail {
        id: "t".into(),
        role: Role::Viewer,
        project: Some("default".into()),
        label: "me".into(),
        created_at: 1,
        expires_at: None,
        revoked_at: None,
        last_used_at: None,
    };
    let token = Token { detail, sha256: "x".into(), worker: None, labels: vec![], parent: None };
    assert!(!queue.store.has_tokens().await.unwrap());
    queue.store.add_token(&token).await.unwrap();
    let found = queue.store.token("t").await.unwrap().unwrap();
    assert_eq!((found.detail.role, found.detail.revoked_at), (Role::Viewer, None));
    queue.store.revoke_token("t", 9).await.unwrap();
    assert_eq!(queue.store.token("t").await.unwrap().unwrap().detail.revoked_at, Some(9));
    assert!(queue.store.revoke_token("u", 9).await.is_err());

    queue.store.add_ticket("k", "secret", 2, &["gpu".into()], 100).await.unwrap();
    assert!(queue.store.use_ticket("k", "wrong", 50).await.is_err());
    assert!(queue.store.use_ticket("k", "secret", 101).await.is_err());
    assert_eq!(queue.store.use_ticket("k", "secret", 50).await.unwrap(), ["gpu"]);
    assert!(queue.store.use_ticket("k", "secret", 50).await.is_ok());
    assert!(queue.store.use_ticket("k", "secret", 50).await.is_err(), "both uses are gone");
}

async fn live_names_belong_to_their_token(mut queue: Queue) {
    let request = registration("w");
    queue.store.register(&request, &[], Some("t1"), "s1", queue.now).await.unwrap();
    assert!(queue.store.register(&request, &[], Some("t2"), "s2", queue.now).await.is_err());
    queue.store.register(&request, &[], Some("t1"), "s3", queue.now).await.expect("its own token may");
    assert!(queue.store.session("s1").await.is_err(), "the earlier process is over");
    assert_eq!(queue.store.session("s3").await.unwrap().token.as_deref(), Some("t1"));
    queue.now += 10 * 60_000;
    queue.store.register(&request, &[], Some("t2"), "s4", queue.now).await.expect("the name is free again");
}

async fn assets_belong_to_projects(queue: Queue) {
    queue.store.add_asset("a", "h1", 5, 1).await.unwrap();
    queue.store.add_asset("a", "h1", 5, 1).await.unwrap();
    let hashes = ["h1".to_string(), "h2".to_string()];
    assert_eq!(queue.store.missing_assets("a", &hashes).await.unwrap(), ["h2"]);
    assert_eq!(queue.store.missing_assets("b", &hashes).await.unwrap(), hashes);
}
