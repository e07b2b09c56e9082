//! Browsers: signing in, what a session may do, how it ends; the pages themselves.

use std::time::Duration;

use protocol::Role;
use serde_json::{Value, json};

use super::Service;

/// A browser: it keeps its cookie, and knows what a change has to send.
struct Browser<'a> {
    service: &'a Service,
    cookie: String,
    csrf: String,
}

/// An answer: its status, its cookie, its body.
struct Answer {
    status: u16,
    cookie: Option<String>,
    body: Value,
}

impl Browser<'_> {
    fn ask(&self, method: &str, path: &str, csrf: bool, body: Option<Value>) -> Answer {
        let config = ureq::Agent::config_builder().http_status_as_error(false);
        let agent: ureq::Agent = config.timeout_global(Some(Duration::from_secs(10))).build().into();
        let mut request =
            ureq::http::Request::builder().method(method).uri(format!("{}{path}", self.service.url));
        if !self.cookie.is_empty() {
            request = request.header("cookie", format!("theme=dark; {}", self.cookie));
        }
        if csrf {
            request = request.header("x-pantaray-csrf", &self.csrf);
        }
        let request = request.header("content-type", "application/json");
        let body = body.unwrap_or(json!({})).to_string();
        let reply = if method == "GET" {
            agent.run(request.body(()).unwrap())
        } else {
            agent.run(request.body(body).unwrap())
        };
        let mut reply = reply.unwrap();
        let cookie = reply.headers().get("set-cookie").map(|value| value.to_str().unwrap().to_owned());
        let text = reply.body_mut().read_to_string().unwrap_or_default();
        let body = serde_json::from_str(&text).unwrap_or(Value::Null);
        Answer { status: reply.status().as_u16(), cookie, body }
    }

    fn sign_in(&mut self, token: &str) -> Answer {
        let answer = self.ask("POST", "/v1/session", false, Some(json!({ "token": token })));
        if let Some(cookie) = &answer.cookie {
            self.cookie = cookie.split(';').next().unwrap().to_owned();
        }
        self.csrf = answer.body["csrf"].as_str().unwrap_or_default().to_owned();
        answer
    }
}

/// Catches a session that a script could read or another site use, one that may more than its token, and one that
/// outlives it.
#[test]
fn a_browser_signs_in_and_out() {
    let folder = tempfile::tempdir().unwrap();
    let service = Service::start(folder.path(), None);
    let admin = service.token(Role::Admin, None);
    let mut browser = Browser { service: &service, cookie: String::new(), csrf: String::new() };
    assert_eq!(browser.ask("GET", "/v1/session", false, None).status, 401);
    let answer = browser.sign_in(&admin);
    assert_eq!((answer.status, answer.body["role"].as_str()), (200, Some("admin")));
    let cookie = answer.cookie.unwrap();
    for word in ["HttpOnly", "SameSite=Lax", "Path=/", "Max-Age=604800"] {
        assert!(cookie.contains(word), "{cookie}");
    }
    assert!(!cookie.contains(&admin), "the cookie is the token");

    // A change needs the header, reading does not
    assert_eq!(browser.ask("GET", "/v1/jobs", false, None).status, 200);
    let project = json!({ "name": "p", "share": 1, "running_max": null });
    let refused = browser.ask("PUT", "/v1/projects/p", false, Some(project.clone()));
    assert_eq!((refused.status, refused.body["code"].as_str()), (403, Some("forbidden")));
    assert_eq!(browser.ask("PUT", "/v1/projects/p", true, Some(project)).status, 200);

    // Sessions are no tokens: they are not listed, and make no sessions
    let tokens = browser.ask("GET", "/v1/tokens", false, None).body;
    assert_eq!(tokens.as_array().unwrap().len(), 1);
    let secret = browser.cookie.split('=').nth(1).unwrap().to_owned();
    let mut other = Browser { service: &service, cookie: String::new(), csrf: String::new() };
    assert_eq!(other.sign_in(&secret).status, 403);

    // Signed out, its cookie is worth nothing
    let out = browser.ask("DELETE", "/v1/session", true, None);
    assert!(out.status == 204 && out.cookie.unwrap().contains("Max-Age=0"));
    assert_eq!(browser.ask("GET", "/v1/jobs", false, None).status, 401);
    assert_eq!(other.sign_in(&admin).status, 200, "the token works on");

    // The session of a revoked token is over
    let viewer = service.token(Role::Viewer, None);
    assert_eq!(browser.sign_in(&viewer).status, 200);
    assert_eq!(browser.ask("GET", "/v1/audit", false, None).status, 403);
    assert_eq!(browser.ask("POST", "/v1/jobs", true, None).status, 403);
    let id = viewer.split('_').nth(1).unwrap();
    assert_eq!(other.ask("POST", &format!("/v1/tokens/{id}/revoke"), true, None).status, 204);
    assert_eq!(browser.ask("GET", "/v1/jobs", false, None).status, 401);

    // Who signed in is written down
    let audit = other.ask("GET", "/v1/audit", false, None).body.to_string();
    assert!(audit.contains("POST /v1/session") && audit.contains("DELETE /v1/session"), "{audit}");
}

/// Catches a worker's token that opens the pages, and a secret that can be guessed at leisure.
#[test]
fn guesses_are_few() {
    let folder = tempfile::tempdir().unwrap();
    let service = Service::start(folder.path(), None);
    let worker = service.token(Role::Worker, None);
    let mut browser = Browser { service: &service, cookie: String::new(), csrf: String::new() };
    assert_eq!(browser.sign_in(&worker).status, 403);
    let wrong = format!("pantaray_{}_{}", "0".repeat(26), "0".repeat(32));
    let statuses: Vec<u16> = (0..25).map(|_| browser.sign_in(&wrong).status).collect();
    assert!(statuses.contains(&401) && statuses.contains(&429), "{statuses:?}");
}

/// Catches pages that need a token before anybody can give one, or come without their policy.
#[test]
fn pages_are_there_for_everybody() {
    let folder = tempfile::tempdir().unwrap();
    let service = Service::start(folder.path(), None);
    for path in ["/", "/jobs/x/bake", "/workers", "/dashboard/app.js", "/dashboard/style/base.css"] {
        let reply = ureq::get(format!("{}{path}", service.url)).call().unwrap();
        let policy = reply.headers()["content-security-policy"].to_str().unwrap();
        assert!(policy.contains("script-src 'self'") && !policy.contains("unsafe"), "{policy}");
    }
    assert!(ureq::get(format!("{}/dashboard/nothing.js", service.url)).call().is_err());
}

/// Catches a farm whose figures do not add up, and a project's viewer who sees others' jobs in them.
#[test]
fn the_farm_is_seen_at_a_glance() {
    let folder = tempfile::tempdir().unwrap();
    let service = Service::start(folder.path(), None);
    let client = service.client(Role::Submitter);
    let request = service.request(&client);
    let job = client.submit(&request, "1").unwrap().jobs.remove(0);
    let mut after = request;
    after.depends_on = vec![job.clone()];
    client.submit(&after, "2").unwrap();
    let ask = |path: &str, project: Option<&str>| {
        let token = service.token(Role::Viewer, project);
        super::ask(&format!("{}{path}", service.url), "GET", Some(&token), None)
    };
    super::people::wait_until(|| ask("/v1/farm", None).1["ready"] == 1);
    let farm = ask("/v1/farm", None).1;
    assert_eq!((farm["jobs"].as_i64(), farm["running"].as_i64()), (Some(2), Some(0)), "{farm}");
    assert_eq!(farm["waiting"], json!({ "dependency": 1, "no_worker": 1 }));
    assert_eq!(ask("/v1/leases", None).1, json!([]));
    let page = ask("/v1/jobs?search=CAMP&sort=state&order=asc&limit=1&offset=1", None).1;
    assert_eq!((page["total"].as_i64(), page["jobs"].as_array().unwrap().len()), (Some(2), 1));
    let page = ask("/v1/jobs", None).1;
    assert_eq!(page["live"][&job]["waiting"], "no_worker", "{page}");

    let admin = service.token(Role::Admin, None);
    let other = json!({ "name": "other", "share": 100, "running_max": null });
    super::ask(&format!("{}/v1/projects/other", service.url), "PUT", Some(&admin), Some(other));
    let farm = ask("/v1/farm", Some("other")).1;
    assert_eq!((farm["jobs"].as_i64(), farm["ready"].as_i64()), (Some(0), Some(0)), "{farm}");
    assert_eq!(ask(&format!("/v1/jobs/{job}/pace"), Some("other")).0, 404);
    let skies = ask("/v1/skies", None).1;
    assert_eq!(skies.as_array().unwrap().len(), 3);
    assert_eq!(skies[0]["light"][2].as_array().unwrap().len(), 36);
}
