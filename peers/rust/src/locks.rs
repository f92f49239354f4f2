//! Locks: the queue for them, the grants, their leases; the same mutex guards them as the arm.

use crate::robot::{now_s, Robot, ARM};
use crate::wire::{array, field, map, Call, Failure, Token};
use rmpv::Value;
use std::time::{Duration, Instant};

const REMEMBERED: usize = 4096;

#[derive(Clone)]
pub struct Holder {
    pub identity: String,
    pub session: String,
    pub purpose: String,
    pub delegates: Vec<String>,
    pub since: f64,
}

impl Holder {
    pub fn container(&self) -> &str {
        self.session.split('/').nth(1).unwrap_or(&self.session)
    }

    fn value(&self) -> Value {
        map([
            ("identity", self.identity.as_str().into()),
            ("container", self.container().into()),
            ("session", self.session.as_str().into()),
            ("purpose", self.purpose.as_str().into()),
            ("since", self.since.into()),
            ("delegates", array(self.delegates.iter().map(String::as_str))),
        ])
    }
}

pub struct Grant {
    pub resources: Vec<&'static str>,
    pub holder: Holder,
    pub lease: Duration,
    pub until: Instant,
    pub uses: u64,
    pub last_use: f64,
}

/// Who waits for a lock: for its turn, or, once that has come, for what still runs.
pub struct Waiter {
    pub number: u64,
    pub priority: i64,
    pub resources: Vec<&'static str>,
    pub holder: Holder,
    pub emptying: bool,
}

impl Robot {
    /// Stand in the queue for these; those the call has already are left out. Returns its number, or 0 if it has all.
    pub fn queue(&mut self, names: &[String], holder: Holder, terms: &Value, call: &Call) -> Result<u64, Failure> {
        self.all_there(&call.sessions)?;
        let mut resources = vec![];
        for name in names {
            let Some((known, resource)) = self.resources.get_key_value(name.as_str()) else {
                return Err(Failure::service_gone(name, "there is no such resource here"));
            };
            if !call.tokens.iter().any(|one| one.epoch == self.epoch && one.number == resource.live) {
                resources.push(*known);
            }
        }
        if resources.is_empty() {
            return Ok(0);
        }
        self.numbers += 1;
        let priority = field(terms, "priority").and_then(Value::as_i64).unwrap_or(0);
        let behind = self.waiting.iter().position(|one| !one.emptying && one.priority < priority);
        let waiter = Waiter { number: self.numbers, priority, resources, holder, emptying: false };
        self.waiting.insert(behind.unwrap_or(self.waiting.len()), waiter);
        Ok(self.numbers)
    }

    /// Whether a waiter has come to have what it waits for: then it is out of the queue, and has this grant.
    pub fn granted(&mut self, waiter: u64, lease: Duration, chain: &[u64]) -> Result<Token, Failure> {
        let at = self.waiting.iter().position(|one| one.number == waiter).expect("it is taken out by this alone");
        let one = &self.waiting[at];
        self.all_there(std::slice::from_ref(&one.holder.session))?;
        if !one.emptying {
            let session = &one.holder.session;
            for name in &one.resources {
                if let Some(grant) = self.grants.get(&self.resources[name].live) {
                    return Err(locked(name, &grant.holder, session));
                }
                let before = self.waiting[..at].iter().chain(self.waiting[at..].iter().filter(|other| other.emptying));
                if let Some(other) = before.into_iter().find(|other| other.resources.contains(name)) {
                    return Err(locked(name, &other.holder, session));
                }
            }
            self.waiting[at].emptying = true; // from now on nobody else is let in
        }
        for name in &self.waiting[at].resources {
            let resource = &self.resources[name];
            if resource.calls.keys().any(|(_, id)| !chain.contains(id)) {
                let who = Holder { purpose: "a call that has not ended".into(), ..self.waiting[at].holder.clone() };
                return Err(locked(name, &who, ""));
            }
        }
        let Waiter { number, resources, mut holder, .. } = self.waiting.remove(at);
        holder.since = now_s();
        for name in &resources {
            self.resource(name).live = number;
        }
        let until = Instant::now() + lease;
        self.grants.insert(number, Grant { resources, holder, lease, until, uses: 0, last_use: 0.0 });
        Ok(Token { epoch: self.epoch.clone(), number })
    }

    /// It waits no more.
    pub fn leave_queue(&mut self, waiter: u64) {
        self.waiting.retain(|one| one.number != waiter);
    }

    /// Begin leases anew. Returns those that hold no more, or are another's, and why.
    pub fn renew(&mut self, numbers: &[u64], identity: &str) -> Vec<(u64, String)> {
        let mut not = vec![];
        for number in numbers {
            if let Some(why) = self.over(*number) {
                not.push((*number, why));
                continue;
            }
            let grant = self.grants.get_mut(number).expect("it is not over");
            if grant.holder.identity == identity {
                grant.until = Instant::now() + grant.lease;
            } else {
                not.push((*number, "it is another's".into()));
            }
        }
        not
    }

    /// Give a grant back; with a reason for which it is lost, what moves under it stops. Returns whether it held.
    pub fn release(&mut self, number: u64, identity: &str, lost: &str) -> bool {
        if self.grants.get(&number).is_none_or(|grant| grant.holder.identity != identity) {
            return false;
        }
        if lost.is_empty() {
            self.end(number, "it was given back").is_some()
        } else {
            self.lose(number, lost)
        }
    }

    /// Take a grant away: what moves under it stops.
    pub fn lose(&mut self, number: u64, why: &str) -> bool {
        let Some(grant) = self.end(number, why) else { return false };
        if grant.resources.contains(&ARM) && !self.resources[ARM].calls.is_empty() {
            self.stop("trade", &[], why);
        }
        true
    }

    fn end(&mut self, number: u64, why: &str) -> Option<Grant> {
        let grant = self.grants.remove(&number)?;
        self.ended.insert(number, why.to_owned());
        while self.ended.len() > REMEMBERED {
            self.ended.pop_first();
        }
        for name in &grant.resources {
            self.resource(name).live = 0;
        }
        Some(grant)
    }

    /// What is locked, as `locks` tells it.
    pub fn locks(&self, container: &str) -> Value {
        let told = self.grants.iter().map(|(number, grant)| {
            let shares = |one: &&Waiter| one.resources.iter().any(|name| grant.resources.contains(name));
            let owner = |one: &Waiter| format!("{}/{}", one.holder.identity, one.holder.container());
            map([
                ("token", Token { epoch: self.epoch.clone(), number: *number }.value()),
                ("container", container.into()),
                ("resources", array(grant.resources.iter().copied())),
                ("holder", grant.holder.value()),
                ("left_s", grant.until.saturating_duration_since(Instant::now()).as_secs_f64().into()),
                ("uses", grant.uses.into()),
                ("last_use", grant.last_use.into()),
                ("waiting", array(self.waiting.iter().filter(shares).map(owner))),
            ])
        });
        Value::Array(told.collect())
    }

    /// Let these move again after a stop. Returns which were stopped.
    pub fn resume(&mut self, names: &[String], caller: &str, sessions: &[String]) -> Result<Value, Failure> {
        for name in names {
            let Some((known, resource)) = self.resources.get_key_value(name.as_str()) else {
                return Err(Failure::service_gone(name, "there is no such resource here"));
            };
            if let Some(Grant { holder, .. }) = self.grants.get(&resource.live) {
                let may = caller == holder.identity || holder.delegates.iter().any(|one| one == caller);
                if !(may && sessions.contains(&holder.session)) {
                    return Err(locked(known, holder, &sessions[0]));
                }
            }
        }
        Ok(array(names.iter().filter(|name| self.resource(name).latch.take().is_some()).map(String::as_str)))
    }
}

pub fn lost(name: &str, why: &str) -> Failure {
    let fields = [("resources", array([name])), ("reason", why.into())];
    Failure::new("LockLost", format!("the lock of {name} is lost: {why}"), fields)
}

pub fn locked(name: &str, holder: &Holder, session: &str) -> Failure {
    let owner = format!("{}/{}", holder.identity, holder.container());
    let fields = [
        ("resources", array([name])),
        ("owner", owner.as_str().into()),
        ("purpose", holder.purpose.as_str().into()),
        ("since", holder.since.into()),
        ("own", (holder.session == session).into()),
    ];
    Failure::new("LockedByOther", format!("{name} is locked by {owner} for {:?}", holder.purpose), fields)
}
