//! Calls of others: their clock asked first, the expiry never later than it is meant, locks renewed while they are used.

use crate::robot::clock_ns_at;
use crate::wire::{self, array, field, map, Call, Failure, Handle, Reply, Token};
use rmpv::Value;
use std::collections::{HashMap, HashSet};
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::mpsc::{channel, Receiver, RecvTimeoutError, Sender};
use std::sync::Mutex;
use std::time::{Duration, Instant};
use zenoh::qos::{CongestionControl, Priority};
use zenoh::{Session, Wait};

const LEASE: Duration = Duration::from_secs(2);
const ANSWER: Duration = Duration::from_secs(2);

pub struct Asking {
    session: Session,
    identity: String,
    own: String,
    /// `<container>/<channel>`: of two containers of one name neither hears the other's answers.
    reply: String,
    next: AtomicU64,
    waiting: Mutex<HashMap<u64, (String, Sender<Reply>)>>,
    /// Addresses of the containers whose sign of life stands.
    alive: Mutex<HashSet<String>>,
}

impl Asking {
    pub fn new(session: Session, own: &str, random: u64) -> Asking {
        let [identity, container, epoch] = [0, 1, 2].map(|at| own.split('/').nth(at).unwrap_or_default());
        Asking {
            session,
            identity: identity.to_owned(),
            own: own.to_owned(),
            reply: format!("{container}/{epoch}.r"),
            next: AtomicU64::new((random >> 26 << 24) | 1),
            waiting: Mutex::default(),
            alive: Mutex::default(),
        }
    }

    /// Where answers come.
    pub fn reply_key(&self) -> String {
        format!("reply/*/{}/{}", self.identity, self.reply)
    }

    // --- being told

    pub fn appeared(&self, address: &str) {
        self.alive.lock().unwrap().insert(address.to_owned());
    }

    pub fn lost(&self, address: &str) {
        self.alive.lock().unwrap().remove(address);
        self.waiting.lock().unwrap().retain(|_, (callee, _)| callee != address);
        // who waits hears that nobody answers
    }

    pub fn alive(&self, address: &str) -> bool {
        self.alive.lock().unwrap().contains(address)
    }

    /// An answer counts only if the speaker in its key is the callee.
    pub fn heard(&self, key: &str, payload: &[u8]) {
        let Some(reply) = Reply::read(payload).filter(|reply| reply.status != wire::PROGRESS) else { return };
        let speaker = key.split('/').nth(1).unwrap_or_default();
        let mut waiting = self.waiting.lock().unwrap();
        let meant = waiting.get(&reply.id).is_some_and(|(callee, _)| callee.split('/').next() == Some(speaker));
        if let Some((_, tell)) = meant.then(|| waiting.remove(&reply.id)).flatten() {
            let _ = tell.send(reply); // who asked may have given up
        }
    }

    // --- asking

    /// Call a service for a call, under a lock of these resources of its container if there are any.
    pub fn relay(&self, to: &Handle, resources: &[String], args: Value, outer: &Call) -> Result<Value, Failure> {
        let until = moment(outer.expires_ns.unwrap_or(0), Instant::now());
        let mut inner = self.call("", array::<Value>([]));
        inner.sessions.extend(outer.sessions.iter().cloned());
        inner.calls = [&[outer.id][..], &outer.calls].concat();
        inner.chain = [&outer.chain[..], &["peer.relay".to_owned()]].concat();
        inner.tokens = outer.tokens.clone();
        if resources.is_empty() {
            return self.command(to, args, &inner, until);
        }
        let (lock, asked_at) = self.acquire(to, resources, &inner, until)?;
        let (done, ended) = channel::<()>();
        let result = std::thread::scope(|scope| {
            scope.spawn(|| self.renew(to, &lock, ended));
            inner.tokens.insert(0, lock.clone());
            let result = if asked_at.elapsed() < LEASE {
                self.command(to, args, &inner, until)
            } else {
                let fields =
                    [("resources", array(resources.iter().map(String::as_str))), ("reason", "too late".into())];
                Err(Failure::new("LockLost", "the lock was not confirmed within its lease", fields))
            };
            drop(done);
            result
        });
        let gift = array([Value::from(lock.number), "".into()]);
        let _ = self.stop(to, "release", gift); // where it is not heard, its lease ends it
        result
    }

    fn acquire(&self, to: &Handle, names: &[String], for_: &Call, until: Instant) -> Result<(Token, Instant), Failure> {
        let terms = map([("purpose", "relay".into()), ("lease_s", LEASE.as_secs_f64().into()), ("wait_s", 0.0.into())]);
        let args = Value::Array(vec![array(names.iter().map(String::as_str)), terms]);
        let asked_at = Instant::now();
        let granted = self.command(&system(to, "acquire"), args, for_, until)?;
        match field(&granted, "token").and_then(Token::read) {
            Some(token) => Ok((token, asked_at)),
            None => Err(Failure::service_gone("trade.acquire", "it granted nothing")),
        }
    }

    /// Four times within a lease, until who uses the lock hangs up.
    fn renew(&self, to: &Handle, lock: &Token, ended: Receiver<()>) {
        while ended.recv_timeout(LEASE / 4) == Err(RecvTimeoutError::Timeout) {
            let numbers = Value::Array(vec![array([lock.number])]);
            let _ = self.stop(to, "renew", numbers); // once lost, the callee refuses what comes under it
        }
    }

    /// An actuating call: with the deadline moved into the callee's clock, as early as that may be.
    fn command(&self, to: &Handle, args: Value, for_: &Call, until: Instant) -> Result<Value, Failure> {
        let clock = self.call("clock", array::<Value>([]));
        let answer = self.send(&system(to, "clock"), &clock, false, until)?;
        let expires_ns = Some(expiry_ns(until, answer.clock_ns, Instant::now()));
        let call = Call { id: self.new_id(), service: to.name.clone(), args, expires_ns, ..for_.clone() };
        body(self.send(to, &call, false, until)?, &to.name)
    }

    fn stop(&self, to: &Handle, name: &str, args: Value) -> Result<Value, Failure> {
        let call = self.call(name, args);
        body(self.send(&system(to, name), &call, true, Instant::now() + ANSWER)?, name)
    }

    fn send(&self, to: &Handle, call: &Call, stop: bool, until: Instant) -> Result<Reply, Failure> {
        let (tell, answer) = channel();
        self.waiting.lock().unwrap().insert(call.id, (to.address.clone(), tell));
        if !self.alive(&to.address) {
            self.waiting.lock().unwrap().remove(&call.id);
            return Err(Failure::service_gone(&to.name, "its container has ended or cannot be reached"));
        }
        let (kind, priority) = if stop { ("stop", Priority::RealTime) } else { ("call", Priority::Data) };
        let key = format!("{kind}/{}/{}/{}/{}", self.identity, to.address, to.domain, to.provider);
        let put = self.session.put(key, call.bytes()).congestion_control(CongestionControl::Block);
        let _ = put.express(true).priority(priority).wait(); // what was not sent is not answered
        let reply = answer.recv_timeout(until.saturating_duration_since(Instant::now()));
        self.waiting.lock().unwrap().remove(&call.id);
        reply.map_err(|why| match why {
            RecvTimeoutError::Timeout => Failure::outcome_unknown(&to.name),
            RecvTimeoutError::Disconnected => {
                let container = to.address.split('/').nth(1).unwrap_or_default();
                let fields = [("service", to.name.as_str().into()), ("container", container.into())];
                Failure::new("ContainerLost", format!("container {container} was lost during a call"), fields)
            }
        })
    }

    fn call(&self, service: &str, args: Value) -> Call {
        Call {
            id: self.new_id(),
            service: service.to_owned(),
            reply: self.reply.clone(),
            sessions: vec![self.own.clone()],
            expires_ns: None,
            chain: vec![],
            args,
            calls: vec![],
            tokens: vec![],
        }
    }

    fn new_id(&self) -> u64 {
        self.next.fetch_add(1, Ordering::Relaxed)
    }
}

/// When an expiry of our clock is, seen from now.
fn moment(expires_ns: i64, now: Instant) -> Instant {
    let left_ns = expires_ns.saturating_sub(clock_ns_at(now)).max(0);
    now + Duration::from_nanos(left_ns as u64)
}

/// A moment in the clock of the callee, which it read before now: what its answer took makes it earlier, never later.
fn expiry_ns(until: Instant, their_clock_ns: i64, now: Instant) -> i64 {
    let left_ns = until.saturating_duration_since(now).as_nanos();
    their_clock_ns.saturating_add(i64::try_from(left_ns).unwrap_or(i64::MAX))
}

fn body(reply: Reply, service: &str) -> Result<Value, Failure> {
    let named = [("service", Value::from(service))];
    match reply.status {
        wire::OK => Ok(reply.body),
        wire::ERROR => Err(Failure(reply.body)), // as it came: whoever knows its type
        wire::BUSY => {
            let fields = [("service", service.into()), ("container", "".into())];
            Err(Failure::new("Busy", format!("{service} is busy"), fields))
        }
        wire::EXPIRED => {
            let fields = [("service", service.into()), ("deadline_s", 0.0.into())];
            Err(Failure::new("DeadlineExceeded", format!("{service} came too late"), fields))
        }
        _ => Err(Failure::new("ServiceGone", format!("there is no {service}"), named)),
    }
}

fn system(of: &Handle, name: &str) -> Handle {
    Handle { domain: "trade".into(), provider: "system".into(), name: name.into(), ..of.clone() }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_expiry_is_moved_by_the_time_that_is_left() {
        let now = Instant::now();
        let until = moment(clock_ns_at(now) + 2_000_000_000, now);
        assert_eq!(until, now + Duration::from_secs(2));
        assert_eq!(expiry_ns(until, 500, now + Duration::from_secs(1)), 1_000_000_500);
        assert_eq!(expiry_ns(until, 500, now + Duration::from_secs(3)), 500);
    }

    #[test]
    fn extreme_values_of_others_are_the_latest_and_the_earliest_moment() {
        let now = Instant::now();
        assert_eq!(moment(i64::MIN, now), now);
        let latest = moment(i64::MAX, now);
        assert_eq!(expiry_ns(latest, i64::MAX, now), i64::MAX);
        assert!(expiry_ns(latest, i64::MIN, now) < 0);
        assert_eq!(expiry_ns(now, i64::MIN, now), i64::MIN);
    }
}
