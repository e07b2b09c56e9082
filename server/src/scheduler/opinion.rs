//! Second opinions: a few results are baked again by another worker before one of them counts. Says which, and who is believed.

/// What a worker says that a batch's result is.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Opinion {
    /// The worker.
    pub worker: String,
    /// The result's hash.
    pub sha256: String,
    /// What traced it: results of different devices need not be equal to the byte.
    pub device: Option<String>,
}

/// What becomes of a result.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Judgement {
    /// It counts: nobody else is to be asked, or can be.
    Counts,
    /// It is kept in mind, and another worker is asked.
    Ask,
    /// It counts, since another worker got the same; these got something else.
    Agreed(Vec<String>),
    /// Others got something else, and no two of them the same.
    Split,
}

/// Whether a batch is among those of which a second opinion is wanted: one in `every`, none where that is 0.
pub fn is_chosen(pass: i64, batch: i64, every: u32) -> bool {
    // SplitMix64's last step, which scatters neighbours
    let mut bits = (pass as u64).wrapping_mul(0x9e37_79b9_7f4a_7c15) ^ batch as u64;
    bits = (bits ^ (bits >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    bits = (bits ^ (bits >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    every > 0 && (bits ^ (bits >> 31)).is_multiple_of(u64::from(every))
}

/// Judges `own` beside the opinions that are known. Only a batch's first claim is questioned, and only where there is somebody
/// to ask, so that no batch waits for a worker that never comes.
pub fn judge(known: &[Opinion], own: &Opinion, is_first_claim: bool, has_peer: bool) -> Judgement {
    let comparable = |other: &&Opinion| other.device == own.device;
    let mut others = known.iter().filter(comparable).filter(|other| other.worker != own.worker).peekable();
    if others.peek().is_none() {
        let is_asked = is_first_claim && has_peer && own.device.is_some() && known.is_empty();
        return if is_asked { Judgement::Ask } else { Judgement::Counts };
    }
    if !others.any(|other| other.sha256 == own.sha256) {
        return Judgement::Split;
    }
    // A worker that contradicts what it said before is among them
    let wrong = known.iter().filter(comparable).filter(|other| other.sha256 != own.sha256);
    Judgement::Agreed(wrong.map(|other| other.worker.clone()).collect())
}

/// The device that a worker's labels name.
pub fn device(labels: &[String]) -> Option<String> {
    labels.iter().find_map(|label| label.strip_prefix("device=")).map(str::to_owned)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn opinion(worker: &str, sha256: &str, device: Option<&str>) -> Opinion {
        Opinion { worker: worker.into(), sha256: sha256.into(), device: device.map(str::to_owned) }
    }

    /// Catches a share that is not the stated one, and neighbours that are chosen together.
    #[test]
    fn one_in_so_many_is_chosen() {
        let chosen = (0..1_000_000).filter(|&batch| is_chosen(7, batch, 1_000)).count();
        assert!((900..1_100).contains(&chosen), "{chosen}");
        assert!((0..1_000).all(|batch| is_chosen(7, batch, 1) && !is_chosen(7, batch, 0)));
    }

    /// Catches an honest worker that is outvoted, a wrong one that is believed, and a batch that waits for nobody.
    #[test]
    fn two_who_agree_are_believed() {
        let (cpu, gpu) = (Some("cpu"), Some("gpu"));
        let (right, wrong) = (opinion("a", "right", cpu), opinion("b", "wrong", cpu));
        assert_eq!(judge(&[], &right, true, true), Judgement::Ask);
        for (is_first, has_peer) in [(true, false), (false, true)] {
            assert_eq!(judge(&[], &right, is_first, has_peer), Judgement::Counts);
        }
        assert_eq!(judge(&[], &opinion("a", "right", None), true, true), Judgement::Counts);
        let known = [right.clone(), wrong.clone()];
        assert_eq!(judge(&known[..1], &opinion("b", "right", cpu), false, true), Judgement::Agreed(vec![]));
        assert_eq!(judge(&known[..1], &wrong, false, true), Judgement::Split);
        // The third decides; and the second may see that it was wrong
        let decided = Judgement::Agreed(vec!["b".into()]);
        assert_eq!(judge(&known, &opinion("c", "right", cpu), false, true), decided);
        assert_eq!(judge(&known, &opinion("b", "right", cpu), false, true), decided);
        // Another device has nothing to say about it, and nobody agrees with themselves
        assert_eq!(judge(&known[..1], &opinion("c", "other", gpu), false, true), Judgement::Counts);
        assert_eq!(judge(&known, &right, false, true), Judgement::Split);
    }
}
