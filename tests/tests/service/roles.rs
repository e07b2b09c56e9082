//! Who may do what: every operation of the OpenAPI document, with every role.

use protocol::Role;
use serde_json::json;

use super::{Service, ask};

/// Catches an operation that a role may not use and can, or may use and cannot, and one that asks nobody who they are.
#[test]
fn every_operation_obeys_its_role() {
    let folder = tempfile::tempdir().unwrap();
    let service = Service::start(folder.path(), None);
    let tokens: Vec<(Role, String)> =
        Role::ALL.iter().map(|&role| (role, service.token(role, None))).collect();
    let operations = server::http::roles(&server::http::document());
    assert!(operations.len() > 30, "{}", operations.len());
    for ((method, path), needed) in &operations {
        let place = path.replace("{pass}", "1").replace("{batch}", "1");
        let place = place.split('/').map(|part| if part.starts_with('{') { "x" } else { part });
        let url = format!("{}{}", service.url, place.collect::<Vec<_>>().join("/"));
        let body = (method != "GET").then(|| json!({}));
        let (status, problem) = ask(&url, method, None, body.clone());
        match needed {
            Some(_) => assert_eq!(status, 401, "{method} {path} without a token: {problem}"),
            None => assert!(![401, 403, 404, 405].contains(&status), "{method} {path}: {status} {problem}"),
        }
        for (role, token) in &tokens {
            let (status, problem) = ask(&url, method, Some(token), body.clone());
            match needed.is_none_or(|needed| role.may(needed)) {
                true => assert!(
                    ![401, 403, 405].contains(&status) && status < 500,
                    "{method} {path} as {role}: {status} {problem}"
                ),
                false => assert_eq!(status, 403, "{method} {path} as {role}: {problem}"),
            }
            if status >= 400 {
                assert_eq!(problem["status"], status, "{method} {path} as {role}: {problem}");
            }
        }
    }
}

/// Catches a token that works when it was revoked or is another's, and a project that others can see.
#[test]
fn tokens_end_and_projects_are_apart() {
    let folder = tempfile::tempdir().unwrap();
    let service = Service::start(folder.path(), None);
    let admin = service.token(Role::Admin, None);
    let client = service.client(Role::Submitter);
    let job = client.submit(&service.request(&client), "key").unwrap().jobs.remove(0);
    let url = |path: &str| format!("{}{path}", service.url);

    // Of another project: the job is not there, and nothing can be put into this one
    let other = json!({ "name": "other", "share": 100, "running_max": null });
    assert_eq!(ask(&url("/v1/projects/other"), "PUT", Some(&admin), Some(other)).0, 200);
    let stranger = service.token(Role::Submitter, Some("other"));
    assert_eq!(ask(&url(&format!("/v1/jobs/{job}")), "GET", Some(&stranger), None).0, 404);
    assert_eq!(ask(&url(&format!("/v1/jobs/{job}/cancel")), "POST", Some(&stranger), None).0, 404);
    let (status, page) = ask(&url("/v1/jobs"), "GET", Some(&stranger), None);
    assert_eq!((status, page["jobs"].as_array().unwrap().len()), (200, 0));
    let request = serde_json::to_value(service.request(&client)).unwrap();
    assert_eq!(ask(&url("/v1/jobs"), "POST", Some(&stranger), Some(request.clone())).0, 403);
    // The same hash in another project gives no access to it
    let mut theirs = request;
    theirs["project"] = json!("other");
    assert_eq!(ask(&url("/v1/jobs"), "POST", Some(&stranger), Some(theirs)).0, 409);

    // Revoked, or with another secret
    let id = stranger.split('_').nth(1).unwrap();
    assert_eq!(ask(&url(&format!("/v1/tokens/{id}/revoke")), "POST", Some(&admin), None).0, 204);
    assert_eq!(ask(&url("/v1/jobs"), "GET", Some(&stranger), None).0, 401);
    let forged = format!("{}{}", &admin[..admin.len() - 1], if admin.ends_with('0') { '1' } else { '0' });
    assert_eq!(ask(&url("/v1/jobs"), "GET", Some(&forged), None).0, 401);

    // Who did what is written down
    let (_, audit) = ask(&url("/v1/audit"), "GET", Some(&admin), None);
    let actions: Vec<&str> =
        audit["entries"].as_array().unwrap().iter().filter_map(|e| e["action"].as_str()).collect();
    assert!(actions.contains(&format!("POST /v1/tokens/{id}/revoke").as_str()), "{actions:?}");
}

/// Catches a ticket that works once too often, and a worker's token that works under another name; an enrolment of which nobody hears.
#[test]
fn tickets_make_tokens_for_one_name() {
    let folder = tempfile::tempdir().unwrap();
    let service = Service::start(folder.path(), None);
    let admin = service.token(Role::Admin, None);
    let url = |path: &str| format!("{}{path}", service.url);
    let ticket = json!({ "uses": 1, "expires_s": 600, "labels": ["room=3"] });
    let (status, ticket) = ask(&url("/v1/tickets"), "POST", Some(&admin), Some(ticket));
    assert_eq!(status, 200, "{ticket}");
    let enrol = json!({ "ticket": ticket["secret"], "name": "w1" });
    let (status, worker) = ask(&url("/v1/enrol"), "POST", None, Some(enrol.clone()));
    assert_eq!(status, 200, "{worker}");
    assert_eq!(ask(&url("/v1/enrol"), "POST", None, Some(enrol)).0, 401);
    let register = |name: &str| json!({ "name": name, "protocol": 1 });
    let token = worker["secret"].as_str();
    assert_eq!(ask(&url("/v1/workers"), "POST", token, Some(register("w2"))).0, 403);
    assert_eq!(ask(&url("/v1/workers"), "POST", token, Some(register("w1"))).0, 200);
    let (_, workers) = ask(&url("/v1/workers"), "GET", Some(&admin), None);
    assert_eq!(workers[0]["labels"], json!(["room=3"]), "{workers}");
    let (_, audit) = ask(&url("/v1/audit"), "GET", Some(&admin), None);
    let entry = audit["entries"].as_array().unwrap().iter().find(|entry| entry["action"] == "POST /v1/enrol");
    let entry = entry.unwrap_or_else(|| panic!("{audit}"));
    assert_eq!((&entry["actor"], &entry["token"]), (&json!("worker w1"), &worker["id"]));
}
