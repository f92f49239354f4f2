//! What is judged about motion, in one place and under one mutex: the arm, its stops, its e-stops; `locks.rs` has its locks.
//!
//! The arm is simulated: a thread moves it a step every five milliseconds. Before each step it looks whether what the
//! turn was admitted under still holds, as a thread that writes to a bus would right before its bytes go out.

use crate::locks::{locked, lost, Grant, Waiter};
use crate::once::{Key, Once};
use crate::wire::{Call, Estop, Failure, Token};
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

#[derive(Default)]
pub struct Resource {
    /// The grant that holds now; 0 is none.
    pub live: u64,
    /// Raised by every stop: what was admitted under a lower one is void.
    pub stops: u64,
    pub latch: Option<(String, String)>,
    /// What is admitted and has not ended, and for whom.
    pub calls: HashMap<Key, Vec<String>>,
    /// For whom it was moved last.
    pub movers: Vec<String>,
}

/// What a call was admitted under.
#[derive(Clone)]
pub struct Permit {
    resource: &'static str,
    key: Key,
    live: u64,
    stops: u64,
}

pub struct Turn {
    permit: Permit,
    goal_rad: f64,
    expires_ns: i64,
}

pub struct Robot {
    pub epoch: String,
    pub once: Once,
    pub angle_rad: f64,
    pub began: u64,
    pub turn: Option<Turn>,
    /// Turns that ended before their goal, and why, until their calls have heard of it.
    pub failed: HashMap<Key, Failure>,
    pub resources: BTreeMap<&'static str, Resource>,
    pub grants: BTreeMap<u64, Grant>,
    pub ended: BTreeMap<u64, String>,
    pub waiting: Vec<Waiter>,
    pub numbers: u64,
    /// Sessions that are not there any more, the last few thousand.
    pub gone: (HashSet<String>, VecDeque<String>),
    pub estops: BTreeMap<String, Estop>,
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
    pub fn over(&self, number: u64) -> Option<String> {
        match self.grants.get(&number) {
            Some(grant) if grant.until > Instant::now() => None,
            Some(_) => Some("its lease ended".into()),
            None => Some(self.ended.get(&number).cloned().unwrap_or_else(|| "it ended long ago".into())),
        }
    }

    pub fn all_there(&self, sessions: &[String]) -> Result<(), Failure> {
        let whole = |session: &String| session.split('/').take(3).collect::<Vec<_>>().join("/");
        match sessions.iter().find(|one| self.gone.0.contains(*one) || self.gone.0.contains(&whole(one))) {
            None => Ok(()),
            Some(session) => {
                let fields = [("session", session.as_str().into()), ("reason", "it was closed".into())];
                Err(Failure::new("SessionEnded", format!("session {session} has ended"), fields))
            }
        }
    }

    pub fn resource(&mut self, name: &str) -> &mut Resource {
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

/// The monotonic clock by which calls expire here; begins with the process.
pub fn clock_ns() -> i64 {
    clock_ns_at(Instant::now())
}

pub fn clock_ns_at(moment: Instant) -> i64 {
    static BEGAN: OnceLock<Instant> = OnceLock::new();
    moment.saturating_duration_since(*BEGAN.get_or_init(|| moment)).as_nanos() as i64 + 1
}

pub fn now_s() -> f64 {
    SystemTime::now().duration_since(UNIX_EPOCH).map_or(0.0, |since| since.as_secs_f64())
}
