//! No call that actuates runs twice: what was answered is kept until it can come no more.

use crate::wire::{Failure, ERROR};
use rmpv::Value;
use std::collections::{BTreeSet, HashMap, VecDeque};

const GRACE_NS: i64 = 5_000_000_000;
const MOST_CALLS: usize = 65_536;
const MOST_BYTES: usize = 64 << 20;

/// Who called, and the call's id.
pub type Key = (String, u64);
pub type Answer = (u64, Value);

enum Entry {
    /// It runs; the reply keys of the same call, come again meanwhile.
    Running {
        again: Vec<String>,
        cancelled: bool,
    },
    Ended(Answer),
}

pub enum First {
    /// Run it, and say how it ended.
    Yes,
    /// It runs already: its answer goes to this one, too.
    Runs,
    /// It has run, or is not to run.
    Ended(Answer),
}

#[derive(Default)]
pub struct Once {
    calls: HashMap<Key, Entry>,
    until: BTreeSet<(i64, Key)>,
    /// Answers and their sizes, oldest first.
    kept: VecDeque<(Key, usize)>,
    bytes: usize,
    /// The highest id that was let go of before its time, of each caller and beginning of ids.
    let_go: HashMap<(String, u64), u64>,
}

impl Once {
    pub fn begin(&mut self, key: &Key, reply: &str, service: &str) -> First {
        match self.calls.get_mut(key) {
            Some(Entry::Running { again, .. }) => {
                again.push(reply.to_owned());
                return First::Runs;
            }
            Some(Entry::Ended(answer)) => return First::Ended(answer.clone()),
            None => {}
        }
        if self.let_go.get(&(key.0.clone(), key.1 >> 24)).is_some_and(|highest| key.1 <= *highest) {
            return First::Ended((ERROR, Failure::outcome_unknown(service).0));
        }
        self.calls.insert(key.clone(), Entry::Running { again: vec![], cancelled: false });
        First::Yes
    }

    /// How it ended. Returns where else that is to be told.
    pub fn end(&mut self, key: &Key, answer: &Answer, bytes: usize, until_ns: i64, now_ns: i64) -> Vec<String> {
        let was = self.calls.insert(key.clone(), Entry::Ended(answer.clone()));
        self.until.insert((until_ns.max(now_ns).saturating_add(GRACE_NS), key.clone()));
        self.kept.push_back((key.clone(), bytes));
        self.bytes += bytes;
        self.tidy(now_ns);
        match was {
            Some(Entry::Running { again, .. }) => again,
            _ => vec![],
        }
    }

    /// The caller wants it to end, or never to begin.
    pub fn cancel(&mut self, key: &Key, service: &str, keep_ns: i64, now_ns: i64) {
        match self.calls.get_mut(key) {
            Some(Entry::Running { cancelled, .. }) => *cancelled = true,
            Some(Entry::Ended(_)) => {}
            None => {
                self.calls.insert(key.clone(), Entry::Ended((ERROR, Failure::cancelled(service).0)));
                self.until.insert((now_ns.saturating_add(keep_ns).saturating_add(GRACE_NS), key.clone()));
                self.tidy(now_ns);
            }
        }
    }

    pub fn cancelled(&self, key: &Key) -> bool {
        matches!(self.calls.get(key), Some(Entry::Running { cancelled: true, .. }))
    }

    fn tidy(&mut self, now_ns: i64) {
        while self.bytes > MOST_BYTES {
            let Some((key, size)) = self.kept.pop_front() else { break };
            self.bytes -= size;
            if let Some(entry @ Entry::Ended(_)) = self.calls.get_mut(&key) {
                *entry = Entry::Ended((ERROR, Failure::outcome_unknown("it").0));
            }
        }
        while let Some((until_ns, key)) = self.until.first().cloned() {
            if until_ns >= now_ns && self.until.len() <= MOST_CALLS {
                break;
            }
            self.until.pop_first();
            self.calls.remove(&key);
            if let Some(at) = self.kept.iter().position(|(kept, _)| *kept == key) {
                self.bytes -= self.kept.remove(at).map_or(0, |(_, size)| size);
            }
            if until_ns >= now_ns {
                let highest = self.let_go.entry((key.0, key.1 >> 24)).or_default();
                *highest = key.1.max(*highest);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::wire::OK;

    const NOW_NS: i64 = 1_000_000_000;

    fn key() -> Key {
        ("anna".into(), 7)
    }

    #[test]
    fn what_never_expires_is_kept_and_does_not_run_again() {
        let mut once = Once::default();
        assert!(matches!(once.begin(&key(), "a/r", "peer.turn"), First::Yes));
        once.end(&key(), &(OK, 1.into()), 1, i64::MAX, NOW_NS);
        once.end(&("bob".into(), 8), &(OK, 2.into()), 1, i64::MIN, NOW_NS); // tidies
        assert!(matches!(once.begin(&key(), "a/r", "peer.turn"), First::Ended((OK, _))));
    }

    #[test]
    fn what_is_cancelled_for_ever_before_it_came_never_begins() {
        let mut once = Once::default();
        once.cancel(&key(), "peer.turn", i64::MAX, NOW_NS);
        assert!(matches!(once.begin(&key(), "a/r", "peer.turn"), First::Ended((ERROR, _))));
    }
}
