//! Throughput of the queue alone, by hand: `PANTARAY_BENCH=1 cargo test --release -p tests --test queue bench -- --nocapture`.

use std::time::Instant;

use crate::{Queue, all_done, on_both};

on_both! {
    /// Prints claim and complete pairs of 16 a second; catches nothing but a batch that is lost.
    claims_and_completes
}

async fn claims_and_completes(queue: Queue) {
    if std::env::var_os("PANTARAY_BENCH").is_none() {
        return;
    }
    const BATCHES: i64 = 200_000;
    let start = Instant::now();
    let bake = queue.baking("j", BATCHES).await;
    println!("{BATCHES} batches created in {:.2} s", start.elapsed().as_secs_f64());
    for clients in [1, 8, 16] {
        let start = Instant::now();
        let work = (0..clients).map(|client| {
            let queue = queue.clone();
            tokio::spawn(async move {
                let (mut pairs, worker) = (0, format!("w{client}"));
                let mut segment = client * bake.segments / clients;
                while start.elapsed().as_secs_f64() < 4.0 {
                    match queue.claim(&worker, bake.pass, segment, 16).await {
                        Some(granted) => {
                            queue.complete(&worker, bake.pass, &granted, &all_done(&granted)).await;
                            pairs += granted.batches.len();
                        }
                        None => segment = (segment + 1) % bake.segments,
                    }
                }
                pairs
            })
        });
        let mut batches = 0;
        for client in work.collect::<Vec<_>>() {
            batches += client.await.unwrap();
        }
        let rate = batches as f64 / start.elapsed().as_secs_f64();
        println!("{} clients: {rate:.0} batches/s", clients);
    }
}
