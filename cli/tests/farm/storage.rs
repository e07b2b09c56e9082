//! Bytes elsewhere: objects in S3 by signed URLs, a coordinator behind TLS.

use std::sync::Arc;

use crate::processes::Farm;
use crate::proxy::{Fault, Proxy, Rule};
use crate::s3::S3;

/// A farm whose objects lie below a prefix of a bucket, behind a proxy. The credentials are the server's own examples.
fn farm_in_s3(proxy: &Proxy) -> Farm {
    let environment = vec![
        ("AWS_ACCESS_KEY_ID", "testing".to_owned()),
        ("AWS_SECRET_ACCESS_KEY", "testing".to_owned()),
        ("AWS_REGION", "us-east-1".to_owned()),
        ("AWS_ENDPOINT", format!("http://127.0.0.1:{}", proxy.port)),
    ];
    Farm::start_with(&["--insecure-local", "--storage", "s3://films/show/one"], environment)
}

/// Catches a farm that does not work with S3: a put without a length, a prefix that is left out, a range read otherwise,
/// bytes of workers that pass through the coordinator.
#[test]
fn objects_lie_in_s3() {
    let Some(s3) = S3::start() else { return };
    let proxy = Proxy::start(s3.port, None);
    let mut farm = farm_in_s3(&proxy);
    farm.worker("first");
    let job = farm.submit(1);
    farm.wait(&job);
    farm.expect_same(&job);
    assert!(!std::path::Path::new(&farm.at("data/storage")).exists());
    // A worker whose cache is too small for the brick map reads ranges of it
    farm.end("first");
    farm.worker_at("small", &format!("http://127.0.0.1:{}", farm.port), &["--cache-size", "2MiB"]);
    let ranges = Rule::new("GET /films/show/one/brickmaps/", "segment", Fault::Dawdle, 1);
    proxy.set(std::slice::from_ref(&ranges));
    let job = farm.submit(1);
    farm.wait(&job);
    farm.expect_same(&job);
    assert!(ranges.is_spent(), "no brick was read");
}

/// Catches an upload or a download that is believed though it was cut off, and trouble of the storage that costs a batch
/// or a job.
#[test]
fn storage_may_refuse_dawdle_and_cut_off() {
    let Some(s3) = S3::start() else { return };
    let proxy = Proxy::start(s3.port, None);
    let mut farm = farm_in_s3(&proxy);
    let rules = [
        Rule::new("PUT /", ".part", Fault::CutRequest, 2),
        Rule::new("PUT /", "", Fault::Refuse, 5),
        Rule::new("GET /", "brickmaps", Fault::CutAnswer, 3),
        Rule::new("GET /", "", Fault::Refuse, 5),
        Rule::new("HEAD /", "", Fault::Refuse, 3),
        Rule::new("GET /", "", Fault::Dawdle, 8),
    ];
    proxy.set(&rules);
    farm.worker("first");
    farm.worker("second");
    let job = farm.submit(1);
    farm.wait(&job);
    farm.expect_same(&job);
    let left: Vec<&Rule> = rules.iter().filter(|rule| !rule.is_spent()).collect();
    assert!(left.is_empty(), "did not happen: {left:?}");
    assert_eq!(farm.command(&["logs", &job])["text"], "", "trouble that passes is no failure");
}

/// Catches a bucket that is not there and is only missed when the first job comes.
#[test]
fn a_coordinator_looks_at_its_storage_before_it_listens() {
    let Some(s3) = S3::start() else { return };
    let farm = Farm::start();
    let endpoint = format!("aws_endpoint=http://127.0.0.1:{}", s3.port);
    let data = farm.at("other");
    let keys = ["aws_access_key_id=a", "aws_secret_access_key=b"];
    let mut arguments = vec!["serve", "--data", &data, "--listen", "127.0.0.1:0", "--storage", "s3://nobody"];
    [&endpoint, keys[0], keys[1]].iter().for_each(|option| arguments.extend(["--storage-option", option]));
    let (code, error) = farm.fails(&arguments);
    assert_eq!(code, 1, "{error}");
    assert!(error.contains("NoSuchBucket") && error.contains("hint"), "{error}");
}

/// Catches https that does not work, and a coordinator that is believed though nobody vouches for it.
#[test]
fn a_coordinator_may_stand_behind_tls() {
    let issued = |names: &[&str], authority: bool| {
        let mut params =
            rcgen::CertificateParams::new(names.iter().map(|n| n.to_string()).collect::<Vec<_>>()).unwrap();
        if authority {
            params.is_ca = rcgen::IsCa::Ca(rcgen::BasicConstraints::Unconstrained);
        }
        (params, rcgen::KeyPair::generate().unwrap())
    };
    let (authority, authority_key) = issued(&[], true);
    let (leaf, key) = issued(&["localhost"], false);
    let root = authority.self_signed(&authority_key).unwrap().pem();
    let issuer = rcgen::Issuer::new(authority, authority_key);
    let certificate = leaf.signed_by(&key, &issuer).unwrap();
    let key = rustls::pki_types::PrivateKeyDer::try_from(key.serialize_der()).unwrap();
    let _ = rustls::crypto::ring::default_provider().install_default();
    let tls = rustls::ServerConfig::builder().with_no_client_auth();
    let tls = Arc::new(tls.with_single_cert(vec![certificate.der().clone()], key).unwrap());

    // The machine trusts this authority and no other
    let folder = tempfile::tempdir().unwrap();
    let authority = folder.path().join("authority.pem");
    std::fs::write(&authority, root).unwrap();
    let environment = vec![("SSL_CERT_FILE", authority.to_str().unwrap().to_owned())];
    let mut farm = Farm::start_with(&["--insecure-local"], environment);
    let proxy = Proxy::start(farm.port, Some(tls));
    let url = format!("https://localhost:{}", proxy.port);
    farm.worker_at("first", &url, &[]);
    let job = farm.submit(1);
    farm.wait(&job);
    farm.expect_same(&job);
    let other = format!("https://127.0.0.1:{}", proxy.port);
    let (_, error) = farm.fails(&["jobs", "--url", &other]);
    assert!(error.contains("certificate"), "{error}");
}
