//! What is judged about motion, in one place and under one mutex: the arm, its locks, its stops, its e-stops.
//!
//! The arm is simulated: a thread moves it a step every five milliseconds. Before each step it looks whether what the
//! turn was admitted under still holds, as a thread that writes to a bus would right before its bytes go out.

use crate::once::{Key, Once};
use crate::wire::{array, map, Call, Estop, Failure, Token};
use rmpv::Value;
use std::collections::{BTreeMap, HashMap, HashSet, VecDeque};
use std::sync::OnceLock;
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

pub const ARM: &str = "peer.arm";
/// What stands for a service that names no resource: itself.
pub const RELAY: &str = "peer/relay/relay";
pub const TICK: Duration = Duration::from_millis(5);
const SPEED_RAD_S: f64 = 1.0;
const MOST_RAD: f64 = 60.0;
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
    fn container(&self) -> &str {
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

struct Grant {
    resources: Vec<&'static str>,
    holder: Holder,
    lease: Duration,
    until: Instant,
    uses: u64,
    last_use: f64,
}

/// Who waits for a lock: for its turn, or, once that has come, for what still runs.
pub struct Waiter {
    number: u64,
    priority: i64,
    resources: Vec<&'static str>,
    holder: Holder,
    emptying: bool,
}

#[derive(Default)]
struct Resource {
    /// The grant that holds now; 0 is none.
    live: u64,
    /// Raised by every stop: what was admitted under a lower one is void.
    stops: u64,
    latch: Option<(String, String)>,
    /// What is admitted and has not ended, and for whom.
    calls: HashMap<Key, Vec<String>>,
    /// For whom it was moved last.
    movers: Vec<String>,
}

/// What a call was admitted under.
#[derive(Clone)]
pub struct Permit {
    resource: &'static str,
    key: Key,
    live: u64,
    stops: u64,
}

struct Turn {
    permit: Permit,
    goal_rad: f64,
    expires_ns: i64,
}

pub struct Robot {
    epoch: String,
    pub once: Once,
    pub angle_rad: f64,
    pub began: u64,
    turn: Option<Turn>,
    /// Turns that ended before their goal, and why, until their calls have heard of it.
    failed: HashMap<Key, Failure>,
    resources: BTreeMap<&'static str, Resource>,
    grants: BTreeMap<u64, Grant>,
    ended: BTreeMap<u64, String>,
    waiting: Vec<Waiter>,
    numbers: u64,
    /// Sessions that are not there any more, the last few thousand.
    gone: (HashSet<String>, VecDeque<String>),
    estops: BTreeMap<String, Estop>,
}

impl Robot {
    /// At rest; with the e-stops that were open before.
    pub fn new(epoch: &str, estops: Vec<Estop>) -> Robot {
        Robot {
            epoch: epoch.to_owned(),
            once: Once::default(),
            angle_rad: 0.0,
            began: 0,
            turn: None,
            failed: HashMap::new(),
            resources: [ARM, RELAY].map(|name| (name, Resource::default())).into(),
            grants: BTreeMap::new(),
            ended: BTreeMap::new(),
            waiting: vec![],
            numbers: 0,
            gone: Default::default(),
            estops: estops.into_iter().map(|one| (one.id.clone(), one)).collect(),
        }
    }

    // --- admitting

    /// Let a call begin on a resource, or say why not.
    pub fn admit(&mut self, name: &'static str, caller: &str, call: &Call) -> Result<Permit, Failure> {
        if let Some(estop) = self.estops.values().next() {
            return Err(stopped(name, &estop.by, &format!("e-stop {}: {}", estop.id, estop.reason), true));
        }
        let resource = &self.resources[name];
        if let Some((by, reason)) = &resource.latch {
            return Err(stopped(name, by, reason, false));
        }
        let own = |token: &&Token| token.epoch == self.epoch;
        for token in call.tokens.iter().filter(own) {
            if let Some(why) = self.over(token.number) {
                return Err(lost(name, &why));
            }
        }
        let live = resource.live;
        if live != 0 {
            let shown = call.tokens.iter().filter(own).any(|token| token.number == live);
            let grant = self.grants.get_mut(&live).expect("what is live is granted");
            let holder = &grant.holder;
            if !shown || !(caller == holder.identity || holder.delegates.iter().any(|one| one == caller)) {
                return Err(locked(name, holder, &call.sessions[0]));
            }
            (grant.uses, grant.last_use) = (grant.uses + 1, now_s());
        } else if let Some(next) = self.waiting.iter().find(|one| one.emptying && one.resources.contains(&name)) {
            return Err(locked(name, &next.holder, &call.sessions[0]));
        }
        self.all_there(&call.sessions)?;
        let key = (caller.to_owned(), call.id);
        let resource = self.resources.get_mut(name).expect("it was just there");
        resource.calls.insert(key.clone(), call.sessions.clone());
        resource.movers = call.sessions.clone();
        Ok(Permit { resource: name, key, live, stops: resource.stops })
    }

    /// The call has ended.
    pub fn close(&mut self, permit: &Permit) {
        self.resource(permit.resource).calls.remove(&permit.key);
    }

    /// The last look before anything goes out: equal, not "at least".
    fn gate(&self, permit: &Permit) -> Result<(), Failure> {
        let resource = &self.resources[permit.resource];
        if resource.stops != permit.stops {
            return Err(Failure::stopped_motion("it was stopped"));
        }
        match self.over(permit.live) {
            Some(why) if permit.live != 0 => Err(lost(permit.resource, &why)),
            _ if resource.live == permit.live => Ok(()),
            _ => Err(Failure::stopped_motion("somebody else has it now")),
        }
    }

    /// Why a grant holds no more.
    fn over(&self, number: u64) -> Option<String> {
        match self.grants.get(&number) {
            Some(grant) if grant.until > Instant::now() => None,
            Some(_) => Some("its lease ended".into()),
            None => Some(self.ended.get(&number).cloned().unwrap_or_else(|| "it ended long ago".into())),
        }
    }

    fn all_there(&self, sessions: &[String]) -> Result<(), Failure> {
        let whole = |session: &String| session.split('/').take(3).collect::<Vec<_>>().join("/");
        match sessions.iter().find(|one| self.gone.0.contains(*one) || self.gone.0.contains(&whole(one))) {
            None => Ok(()),
            Some(session) => {
                let fields = [("session", session.as_str().into()), ("reason", "it was closed".into())];
                Err(Failure::new("SessionEnded", format!("session {session} has ended"), fields))
            }
        }
    }

    fn resource(&mut self, name: &str) -> &mut Resource {
        self.resources.get_mut(name).expect("asked for by its own name")
    }

    // --- the arm

    /// Begin a turn, which ends the one before.
    pub fn begin_turn(&mut self, permit: &Permit, goal_rad: f64, expires_ns: Option<i64>) -> Result<(), Failure> {
        if goal_rad.is_nan() || goal_rad.abs() > MOST_RAD {
            let fields = [
                ("what", "angle_rad".into()),
                ("value", goal_rad.into()),
                ("lower", (-MOST_RAD).into()),
                ("upper", MOST_RAD.into()),
                ("unit", "rad".into()),
            ];
            let message = format!("angle_rad: {goal_rad} rad is outside {} to {MOST_RAD} rad", -MOST_RAD);
            return Err(Failure::new("LimitExceeded", message, fields));
        }
        self.halt("another turn began");
        self.began += 1;
        self.turn = Some(Turn { permit: permit.clone(), goal_rad, expires_ns: expires_ns.unwrap_or(0) });
        Ok(())
    }

    /// Whether a turn has ended, and how.
    pub fn ended_turn(&mut self, permit: &Permit) -> Option<Result<f64, Failure>> {
        if let Some(failure) = self.failed.remove(&permit.key) {
            return Some(Err(failure));
        }
        let runs = self.turn.as_ref().is_some_and(|turn| turn.permit.key == permit.key);
        (!runs).then_some(Ok(self.angle_rad))
    }

    fn halt(&mut self, why: &str) {
        if let Some(turn) = self.turn.take() {
            self.failed.insert(turn.permit.key, Failure::stopped_motion(why));
        }
    }

    /// One step of time. Returns whether anything is to be looked at.
    pub fn tick(&mut self) -> bool {
        let now = Instant::now();
        let over: Vec<u64> = self.grants.iter().filter(|(_, grant)| grant.until <= now).map(|(n, _)| *n).collect();
        for number in &over {
            self.lose(*number, "its lease ended");
        }
        let Some(Turn { permit, goal_rad, expires_ns }) = &self.turn else { return !over.is_empty() };
        if let Err(why) = self.gate(permit) {
            self.failed.insert(permit.key.clone(), why);
            self.turn = None;
        } else if clock_ns() >= *expires_ns {
            self.failed.insert(permit.key.clone(), Failure::stopped_motion("the deadline of its call has passed"));
            self.turn = None;
        } else if self.once.cancelled(&permit.key) {
            self.failed.insert(permit.key.clone(), Failure::cancelled("peer.turn"));
            self.turn = None;
        } else {
            let (step_rad, left_rad) = (SPEED_RAD_S * TICK.as_secs_f64(), goal_rad - self.angle_rad);
            if left_rad.abs() > step_rad {
                self.angle_rad += step_rad.copysign(left_rad);
                return !over.is_empty();
            }
            self.angle_rad = *goal_rad;
            self.turn = None;
        }
        true
    }

    // --- stopping

    /// Stop the arm. By others than those for whom it moves, or who have it, it holds until `resume`.
    pub fn stop(&mut self, by: &str, asking: &[String], reason: &str) {
        let holder = self.grants.get(&self.resources[ARM].live).map(|grant| grant.holder.session.clone());
        let arm = self.resource(ARM);
        let used = holder.is_some() || !arm.calls.is_empty() || !arm.movers.is_empty();
        let shared = |sessions: &Vec<String>| sessions.iter().any(|one| asking.contains(one));
        let begun = if arm.calls.is_empty() { shared(&arm.movers) } else { arm.calls.values().all(shared) };
        let own = begun || holder.is_some_and(|session| asking.contains(&session));
        if !asking.is_empty() && used && !own {
            arm.latch = Some((by.to_owned(), reason.to_owned()));
        }
        arm.stops += 1;
        self.halt(reason);
    }

    /// A session is not there any more: what it set moving stops, its locks fall, nothing is let in for it.
    pub fn session_ended(&mut self, session: &str) {
        let within = |one: &String| one == session || one.starts_with(&format!("{session}/"));
        if self.gone.0.insert(session.to_owned()) {
            self.gone.1.push_back(session.to_owned());
        }
        if self.gone.1.len() > REMEMBERED {
            let oldest = self.gone.1.pop_front().unwrap_or_default();
            self.gone.0.remove(&oldest);
        }
        let fallen: Vec<u64> =
            self.grants.iter().filter(|(_, grant)| within(&grant.holder.session)).map(|(number, _)| *number).collect();
        for number in fallen {
            self.lose(number, "its session has ended");
        }
        if self.resources[ARM].calls.values().flatten().any(within) {
            self.stop("trade", &[], &format!("session {session} has ended"));
        }
    }

    /// It was out of reach and is there again.
    pub fn session_back(&mut self, session: &str) {
        if self.gone.0.remove(session) {
            self.gone.1.retain(|one| one != session);
        }
    }

    // --- locks

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
        let priority = crate::wire::field(terms, "priority").and_then(Value::as_i64).unwrap_or(0);
        let behind = self.waiting.iter().position(|one| !one.emptying && one.priority < priority);
        let waiter = Waiter { number: self.numbers, priority, resources, holder, emptying: false };
        self.waiting.insert(behind.unwrap_or(self.waiting.len()), waiter);
        Ok(self.numbers)
    }

    /// Whether a waiter has come to have what it waits for: then it is out of the queue, and has this grant.
    pub fn granted(&mut self, waiter: u64, lease: Duration, chain: &[Key]) -> Result<Token, Failure> {
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
            if resource.calls.keys().any(|key| !chain.contains(key)) {
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
        if !self.grants.get(&number).is_some_and(|grant| grant.holder.identity == identity) {
            return false;
        }
        if lost.is_empty() { self.end(number, "it was given back").is_some() } else { self.lose(number, lost) }
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

    // --- e-stops

    /// Everything stops, and nothing begins before this is cleared.
    pub fn open_estop(&mut self, estop: &Estop) {
        self.estops.insert(estop.id.clone(), estop.clone());
        self.stop(&estop.by, std::slice::from_ref(&estop.by), &format!("e-stop {}: {}", estop.id, estop.reason));
    }

    pub fn clear_estops(&mut self, ids: &[String]) {
        self.estops.retain(|id, _| !ids.contains(id));
    }

    pub fn is_open(&self, id: &str) -> bool {
        self.estops.contains_key(id)
    }

    pub fn open_estops(&self) -> Value {
        Value::Array(self.estops.values().map(Estop::value).collect())
    }
}

fn stopped(name: &str, by: &str, reason: &str, estop: bool) -> Failure {
    let fields =
        [("resource", name.into()), ("by", by.into()), ("reason", reason.into()), ("estop", Value::from(estop))];
    Failure::new("Stopped", format!("{name} was stopped by {by}: {reason}"), fields)
}

fn lost(name: &str, why: &str) -> Failure {
    let fields = [("resources", array([name])), ("reason", why.into())];
    Failure::new("LockLost", format!("the lock of {name} is lost: {why}"), fields)
}

fn locked(name: &str, holder: &Holder, session: &str) -> Failure {
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

/// The monotonic clock by which calls expire here; begins with the process.
pub fn clock_ns() -> i64 {
    static BEGAN: OnceLock<Instant> = OnceLock::new();
    BEGAN.get_or_init(Instant::now).elapsed().as_nanos() as i64 + 1
}

pub fn now_s() -> f64 {
    SystemTime::now().duration_since(UNIX_EPOCH).map_or(0.0, |since| since.as_secs_f64())
}
