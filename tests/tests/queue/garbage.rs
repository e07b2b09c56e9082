//! Retention: what is fenced off is not referred to, and counts outlive the rows they count.

use std::sync::Arc;

use protocol::{PassKind, PassState};
use server::db::garbage::UnusedAsset;
use server::db::retention::{Aged, DAY_MS, Life, Retention};

use crate::{Queue, all_done, on_both};

on_both! {
    /// Catches a job that uses a brick map while it is being removed, or that waits for it for ever.
    a_map_on_its_way_out_is_built_anew
    /// Catches counts that change when rows go, batches of a job that was tried again, and a retry of what is gone.
    counts_outlive_their_rows
    /// Catches an asset that goes while somebody uploads or submits it.
    assets_go_only_when_nobody_comes
    /// Catches two that collect at once, and a leader that nobody can succeed.
    one_leads_at_a_time
    /// Catches rows that go too early, and numbers of events that begin again.
    old_rows_go_from_the_front
}

async fn a_map_on_its_way_out_is_built_anew(mut queue: Queue) {
    queue.baking("old", 3).await;
    queue.store.cancel("old", "tester", queue.now).await.unwrap();
    queue.advance("old").await;
    assert_eq!(queue.store.unused_maps(i64::MAX, "", 9).await.unwrap(), Vec::<String>::new());
    assert!(!queue.store.fence_map("old").await.unwrap(), "a job within its retention refers to it");
    queue.now += 20 * DAY_MS;
    assert!(queue.store.begin_removal("old", Life::Work).await.unwrap());
    assert_eq!(queue.store.unused_maps(i64::MAX, "", 9).await.unwrap(), ["old"]);
    assert!(queue.store.fence_map("old").await.unwrap());
    // A job on the same occluders comes now
    queue.submit("new").await;
    queue.advance("new").await;
    queue.do_pass("new", PassKind::Import, Some(crate::import(&["set"], "old"))).await;
    let build = queue.pass("new", PassKind::Build).await;
    assert!(queue.claim("w1", build, 0, 1).await.is_none(), "it waits");
    assert_eq!(queue.store.map_gone("old").await.unwrap().as_deref(), Some("new"));
    assert!(queue.claim("w1", build, 0, 1).await.is_some(), "it builds");
    assert!(!queue.store.fence_map("old").await.unwrap());
    assert_eq!(queue.store.map_gone("old").await.unwrap(), None);
}

async fn counts_outlive_their_rows(mut queue: Queue) {
    let bake = queue.baking("j", 1_500).await;
    for segment in 0..bake.segments {
        while let Some(granted) = queue.claim("w1", bake.pass, segment, 64).await {
            let mut items = all_done(&granted);
            items.truncate(if segment == 0 { 3 } else { 64 });
            queue.complete("w1", bake.pass, &granted, &items).await;
            if segment == 0 {
                break;
            }
        }
    }
    assert!(queue.store.due_jobs(&Retention::default(), i64::MAX / 2, "", 9).await.unwrap().is_empty());
    assert!(!queue.store.begin_removal("j", Life::Work).await.unwrap(), "it has not ended");
    queue.store.cancel("j", "tester", queue.now).await.unwrap();
    queue.now += crate::TTL + 1;
    queue.store.expire(&queue.around(9)).await.unwrap();
    while queue.store.sweep_cancelled().await.unwrap() {}
    queue.advance("j").await;
    let before = queue.store.pass_details("j").await.unwrap();
    let summary = queue.store.job("j").await.unwrap();
    assert!(queue.store.remove_batches("j").await.is_err(), "nobody has said that its work is over");
    let due = queue.store.due_jobs(&Retention::default(), queue.now + 13 * DAY_MS, "", 9).await.unwrap();
    assert!(due.len() == 1 && due[0].attempts && !due[0].work, "{due:?}");
    let due = queue.store.due_jobs(&Retention::default(), queue.now + 15 * DAY_MS, "", 9).await.unwrap();
    assert!(due[0].work && !due[0].logs && !due[0].outputs, "{due:?}");
    assert!(queue.store.begin_removal("j", Life::Work).await.unwrap());
    let mut removed = 0;
    while let Some(count) = queue.store.remove_batches("j").await.unwrap() {
        removed += count;
        assert_eq!(queue.store.drift().await.unwrap(), []);
        let now = queue.store.job("j").await.unwrap();
        assert_eq!((now.batches, now.pruned), (summary.batches, true));
    }
    queue.store.end_removal("j", Life::Work).await.unwrap();
    assert_eq!(removed, 1_500 + 3, "and those of import, build and plan");
    let after = queue.store.pass_details("j").await.unwrap();
    let counts =
        |passes: &[protocol::job::PassDetail]| passes.iter().map(|pass| pass.batches).collect::<Vec<_>>();
    assert_eq!(counts(&after), counts(&before));
    assert_eq!(after[3].state, PassState::Cancelled);
    assert!(queue.store.skip("j", &Default::default(), "tester", queue.now).await.is_err());
}

async fn assets_go_only_when_nobody_comes(queue: Queue) {
    let (a, now) = ("aa".repeat(32), queue.now);
    queue.store.add_asset("default", &a, 7, now).await.unwrap();
    let unused = |before| queue.store.unused_assets(before, ("", ""), 9);
    assert!(unused(now).await.unwrap().is_empty(), "it was used just now");
    let asset = UnusedAsset { project: "default".into(), sha256: a.clone(), bytes: 7 };
    assert_eq!(unused(now + 1).await.unwrap(), std::slice::from_ref(&asset));

    // A job comes between the look and the removal
    let mut job = crate::new_job("j", None);
    Arc::make_mut(&mut job.request).files.insert("f".into(), a.clone());
    queue.store.submit(&[job.clone()], now).await.unwrap();
    assert!(!queue.store.drop_asset(&asset, now + 1, now).await.unwrap());
    assert!(queue.store.missing_assets("default", std::slice::from_ref(&a)).await.unwrap().is_empty());

    // Its work is over: the asset goes, and whoever comes meanwhile is sent away
    queue.store.cancel("j", "tester", now).await.unwrap();
    queue.advance("j").await;
    queue.store.begin_removal("j", Life::Work).await.unwrap();
    while queue.store.remove_batches("j").await.unwrap().is_some() {}
    queue.store.end_removal("j", Life::Work).await.unwrap();
    assert!(queue.store.drop_asset(&asset, now + 1, now).await.unwrap());
    assert!(queue.store.add_asset("default", &a, 7, now).await.is_err());
    job.id = "k".into();
    assert!(queue.store.submit(&[job.clone()], now).await.is_err(), "its file is not there");
    queue.store.unmark(&protocol::keys::asset(&a)).await.unwrap();
    queue.store.add_asset("default", &a, 7, now).await.unwrap();
    queue.store.submit(&[job], now).await.unwrap();
}

async fn one_leads_at_a_time(queue: Queue) {
    let lead = |holder: &'static str, now| queue.store.lead("gc", holder, 1_000, now);
    assert!(lead("a", 0).await.unwrap());
    assert!(!lead("b", 999).await.unwrap());
    assert!(lead("a", 999).await.unwrap());
    assert!(!lead("b", 1_500).await.unwrap());
    assert!(lead("b", 2_001).await.unwrap());
    queue.store.step_down("gc", "a").await.unwrap();
    assert!(!lead("a", 2_002).await.unwrap());
    queue.store.step_down("gc", "b").await.unwrap();
    assert!(lead("a", 2_003).await.unwrap());
}

async fn old_rows_go_from_the_front(mut queue: Queue) {
    for number in 0..3 {
        queue.submit(&format!("j{number}")).await;
        queue.now += DAY_MS;
    }
    let last = queue.store.last_event().await.unwrap();
    let before = queue.now - 2 * DAY_MS;
    assert_eq!(queue.store.remove_aged(Aged::Event, before, true).await.unwrap(), 1);
    assert_eq!(queue.store.remove_aged(Aged::Event, before, false).await.unwrap(), 1);
    assert_eq!(queue.store.events(0, 9, None).await.unwrap().len(), 2);
    assert_eq!(
        queue.store.remove_aged(Aged::Event, queue.now, false).await.unwrap(),
        1,
        "the last one stays"
    );
    assert_eq!(queue.store.last_event().await.unwrap(), last);
    assert_eq!(queue.store.remove_aged(Aged::Audit, queue.now, false).await.unwrap(), 0);
}
