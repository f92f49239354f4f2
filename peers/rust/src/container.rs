//! A container: there for others, asked what it offers, called, told of e-stops and of who is gone.

use crate::asking::Asking;
use crate::offers::{entry, find, Effect, Service, PROVIDERS, SYSTEM};
use crate::once::{Answer, First, Key};
use crate::robot::{self, clock_ns, Holder, Robot, TICK};
use crate::store::Store;
use crate::wire::{self, array, field, is_chunk, texts, Call, Estop, EstopOrder, Failure, Handle, Reply};
use rmpv::Value;
use std::collections::{BTreeMap, HashMap};
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::mpsc::Sender;
use std::sync::{Arc, Condvar, Mutex, MutexGuard};
use std::time::{Duration, Instant};
use zenoh::qos::{CongestionControl, Priority};
use zenoh::query::{ConsolidationMode, Query, QueryTarget};
use zenoh::sample::{Locality, Sample, SampleKind};
use zenoh::{Session, Wait};

const MOST_AT_ONCE: usize = 64;
const LOOK: Duration = Duration::from_millis(100);
const MOST_REQUESTS: usize = 4096;

pub struct Container {
    session: Session,
    identity: String,
    name: String,
    /// `<identity>/<container>/<epoch>`
    own: String,
    host: String,
    robot: Mutex<Robot>,
    changed: Condvar,
    registry: Mutex<(u64, BTreeMap<String, Vec<u8>>)>,
    /// Requests about e-stops that were heard, and what of each failed; None while it is being done.
    requests: Mutex<HashMap<String, Option<String>>>,
    store: Store,
    /// One at a time writes or removes notes, so that none outlives its clearing.
    noting: Mutex<()>,
    asking: Asking,
    running: AtomicUsize,
    /// Containers to be asked which e-stops they have open.
    learn: Sender<String>,
}

type Result<T> = std::result::Result<T, Failure>;

impl Container {
    pub fn new(session: Session, own: &str, store: Store, random: u64, learn: Sender<String>) -> Container {
        let chunks: Vec<&str> = own.split('/').collect();
        let estops = store.read();
        let requests = estops.iter().map(|one| (one.id.clone(), Some(String::new()))).collect();
        let hostname = std::fs::read_to_string("/proc/sys/kernel/hostname");
        Container {
            asking: Asking::new(session.clone(), own, random),
            session,
            identity: chunks[0].into(),
            name: chunks[1].into(),
            own: own.into(),
            host: hostname.map_or("unknown".into(), |name| name.trim().into()),
            robot: Mutex::new(Robot::new(chunks[2], estops)),
            changed: Condvar::new(),
            registry: Mutex::default(),
            requests: Mutex::new(requests),
            store,
            noting: Mutex::default(),
            running: AtomicUsize::new(0),
            learn,
        }
    }

    pub fn reply_key(&self) -> String {
        self.asking.reply_key()
    }

    fn robot(&self) -> MutexGuard<'_, Robot> {
        self.robot.lock().unwrap()
    }

    // --- calls

    /// A call or a stop. What reads or stops is done at once, what actuates on a thread of its own.
    pub fn called(self: &Arc<Self>, sample: &Sample) {
        let Some((call, caller, place)) = self.taken(sample) else { return };
        let urgent = sample.key_expr().as_str().starts_with("stop/");
        let service = find(&place.0, &place.1, &call.service).filter(|one| (one.effect == Effect::Stop) == urgent);
        let Some(service) = service else {
            let cancels = urgent && place == (SYSTEM.0.into(), SYSTEM.1.into()) && call.service == "cancel";
            let answer = if cancels { self.cancel(&call, &caller) } else { (wire::GONE, Value::Nil) };
            return self.answer(&call.reply, &caller, call.id, answer);
        };
        if service.effect == Effect::Read || urgent {
            let answer = answer_of(self.run(service, &call, &caller));
            return self.answer(&call.reply, &caller, call.id, answer);
        }
        let key = (caller.clone(), call.id);
        let first = self.robot().once.begin(&key, &call.reply, &service.label());
        match first {
            First::Ended(answer) => self.answer(&call.reply, &caller, call.id, answer),
            First::Runs => {}
            First::Yes if self.running.load(Ordering::Relaxed) >= MOST_AT_ONCE => {
                self.ended(&call, &key, (wire::BUSY, Value::Nil));
            }
            First::Yes => {
                self.running.fetch_add(1, Ordering::Relaxed);
                let me = self.clone();
                std::thread::spawn(move || {
                    let late = call.expires_ns.is_none_or(|expires_ns| clock_ns() >= expires_ns);
                    let answer = if late { (wire::EXPIRED, Value::Nil) } else { answer_of(me.run(service, &call, &caller)) };
                    me.ended(&call, &key, answer);
                    me.running.fetch_sub(1, Ordering::Relaxed);
                });
            }
        }
    }

    /// The call, who makes it and of which provider; None if it is malformed, forged or put on a pattern.
    fn taken(&self, sample: &Sample) -> Option<(Call, String, (String, String))> {
        let key = sample.key_expr().as_str();
        let chunks: Vec<&str> = key.split('/').collect();
        if chunks.len() != 7 || !chunks.iter().all(|chunk| is_chunk(chunk)) || chunks[2..5].join("/") != self.own {
            return None;
        }
        let call = Call::read(&sample.payload().to_bytes())?;
        let forged = !call.sessions[0].starts_with(&format!("{}/", chunks[1]));
        (!forged).then(|| (call, chunks[1].into(), (chunks[5].into(), chunks[6].into())))
    }

    fn ended(&self, call: &Call, key: &Key, answer: Answer) {
        let bytes = wire::encode(&answer.1).len();
        let again = self.robot().once.end(key, &answer, bytes, call.expires_ns.unwrap_or(0), clock_ns());
        for reply in again.iter().chain([&call.reply]) {
            self.answer(reply, &key.0, call.id, answer.clone());
        }
    }

    fn answer(&self, reply: &str, caller: &str, id: u64, (status, body): Answer) {
        let bytes = Reply { id, status, clock_ns: clock_ns(), body }.bytes();
        let put = self.session.put(format!("reply/{}/{caller}/{reply}", self.identity), bytes);
        let _ = put.congestion_control(CongestionControl::Block).express(true).wait(); // who asked may be gone
    }

    fn cancel(&self, call: &Call, caller: &str) -> Answer {
        let args = call.args.as_array().filter(|args| args.len() >= 3);
        let asked = args.and_then(|args| Some((args[0].as_u64()?, args[1].as_str()?, args[2].as_f64()?)));
        let Some((id, service, keep_s)) = asked.filter(|(_, _, keep_s)| (0.0..=86_400.0).contains(keep_s)) else {
            return (wire::ERROR, Failure::argument("trade.cancel", "", "must be [id, service, keep_s]").0);
        };
        self.robot().once.cancel(&(caller.into(), id), service, (keep_s * 1e9) as i64, clock_ns());
        self.changed.notify_all();
        (wire::OK, Value::Nil)
    }

    // --- services

    fn run(&self, service: &Service, call: &Call, caller: &str) -> Result<Value> {
        let args = service.bind(&call.args)?;
        let result = match (service.provider.1, service.name) {
            (_, "echo") => Ok(args[0].clone()),
            (_, "angle") => Ok(self.robot().angle_rad.into()),
            (_, "turns") => Ok(self.robot().began.into()),
            (_, "turn") => self.turn(call, caller, args[0].as_f64().unwrap_or(f64::NAN)),
            (_, "halt") => {
                self.robot().stop(caller, &call.sessions, "stop was called");
                Ok(Value::Nil)
            }
            (_, "relay") => self.relay(call, caller, &args),
            (_, "clock") => Ok(clock_ns().into()),
            (_, "acquire") => self.acquire(call, caller, &names(&args[0], "acquire")?, &args[1]),
            (_, "renew") => {
                let numbers: Vec<u64> = args[0].as_array().into_iter().flatten().filter_map(Value::as_u64).collect();
                let over = self.robot().renew(&numbers, caller);
                Ok(Value::Map(over.into_iter().map(|(number, why)| (number.into(), why.into())).collect()))
            }
            (_, "release") => {
                let lost = args[1].as_str().unwrap_or_default();
                Ok(self.robot().release(args[0].as_u64().unwrap_or(0), caller, lost).into())
            }
            (_, "locks") => Ok(self.robot().locks(&self.name)),
            (_, "break_lock") => {
                let why = format!("broken by {caller}: {}", args[1].as_str().unwrap_or_default());
                Ok(self.robot().lose(args[0].as_u64().unwrap_or(0), &why).into())
            }
            (_, "resume") => self.robot().resume(&names(&args[0], "resume")?, caller, &call.sessions),
            (_, other) => Err(Failure::service_gone(other, "it is not offered")),
        };
        self.changed.notify_all();
        result
    }

    fn turn(&self, call: &Call, caller: &str, goal_rad: f64) -> Result<Value> {
        let mut robot = self.robot();
        let permit = robot.admit(robot::ARM, caller, call)?;
        let begun = robot.begin_turn(&permit, goal_rad, call.expires_ns);
        let mut ended = begun.err().map(Err);
        while ended.is_none() {
            robot = self.changed.wait_timeout(robot, LOOK).unwrap().0;
            ended = robot.ended_turn(&permit);
        }
        robot.close(&permit);
        drop(robot);
        self.changed.notify_all();
        ended.expect("it was waited for").map(Value::from)
    }

    fn relay(&self, call: &Call, caller: &str, args: &[Value]) -> Result<Value> {
        let wrong = |name| Failure::argument("peer.relay", name, "is not what it should be");
        let to = Handle::read(&args[0]).ok_or_else(|| wrong("service"))?;
        let resources = names(&args[1], "relay")?;
        let permit = self.robot().admit(robot::RELAY, caller, call)?;
        let result = self.asking.relay(&to, &resources, args[2].clone(), call);
        self.robot().close(&permit);
        result
    }

    fn acquire(&self, call: &Call, caller: &str, names: &[String], terms: &Value) -> Result<Value> {
        let number = |name: &str, default: f64| field(terms, name).and_then(Value::as_f64).unwrap_or(default);
        let (lease_s, wait_s) = (number("lease_s", 2.0), number("wait_s", 0.0));
        if !(0.1..=60.0).contains(&lease_s) || !(0.0..=3600.0).contains(&wait_s) {
            return Err(Failure::argument("trade.acquire", "terms", "must have a lease_s of 0.1 to 60, a wait_s to 3600"));
        }
        let holder = Holder {
            identity: caller.into(),
            session: call.sessions[0].clone(),
            purpose: field(terms, "purpose").and_then(Value::as_str).unwrap_or_default().into(),
            delegates: field(terms, "delegates").and_then(texts).unwrap_or_default(),
            since: 0.0,
        };
        let chain: Vec<Key> = call.calls.iter().map(|id| (caller.to_owned(), *id)).collect();
        let (asked, mut robot) = (Instant::now(), self.robot());
        let waiter = robot.queue(names, holder, terms, call)?;
        let token = loop {
            if waiter == 0 {
                break Value::Nil; // it has all of them already
            }
            let refused = match robot.granted(waiter, Duration::from_secs_f64(lease_s), &chain) {
                Ok(token) => break token.value(),
                Err(refused) => refused,
            };
            let left = Duration::from_secs_f64(wait_s).saturating_sub(asked.elapsed());
            if left.is_zero() || robot.once.cancelled(&(caller.to_owned(), call.id)) {
                robot.leave_queue(waiter);
                return Err(refused);
            }
            robot = self.changed.wait_timeout(robot, left.min(LOOK)).unwrap().0;
        };
        let granted = if token.is_nil() { array::<Value>([]) } else { array(names.iter().map(String::as_str)) };
        let waited_s = asked.elapsed().as_secs_f64();
        Ok(wire::map([("token", token), ("resources", granted), ("waited_s", waited_s.into())]))
    }

    // --- the registry

    /// Put or change the entries of these providers.
    pub fn announce(&self, providers: &[(&str, &str)]) {
        let mut registry = self.registry.lock().unwrap();
        for provider in providers {
            registry.0 += 1;
            let estops = if *provider == SYSTEM { self.robot().open_estops() } else { array::<Value>([]) };
            let key = format!("registry/{}/{}/{}", provider.0, self.own, provider.1);
            let bytes = wire::encode(&entry(*provider, registry.0, &self.host, estops));
            registry.1.insert(key.clone(), bytes.clone());
            self.put(&key, bytes);
        }
    }

    pub fn announce_all(&self) {
        self.announce(&PROVIDERS);
    }

    /// Say how far it is.
    pub fn beat(&self) {
        let revision = self.registry.lock().unwrap().0;
        self.put(&self.tally_key(), wire::tally(revision));
    }

    /// Answer what is offered: each entry that is asked for, the tally last.
    pub fn asked(&self, query: &Query) {
        let registry = self.registry.lock().unwrap();
        let tally = (self.tally_key(), wire::tally(registry.0));
        for (key, bytes) in registry.1.iter().map(|(key, bytes)| (key.clone(), bytes.clone())).chain([tally]) {
            if zenoh::key_expr::KeyExpr::new(key.as_str()).is_ok_and(|key| query.key_expr().intersects(&key)) {
                let _ = query.reply(key, bytes).wait(); // who asked may be gone
            }
        }
    }

    fn tally_key(&self) -> String {
        format!("registry/trade/{}/tally", self.own)
    }

    fn put(&self, key: &str, bytes: Vec<u8>) {
        let _ = self.session.put(key, bytes).congestion_control(CongestionControl::Block).express(true).wait();
    }

    // --- others

    pub fn answered(&self, sample: &Sample) {
        self.asking.heard(sample.key_expr().as_str(), &sample.payload().to_bytes());
    }

    /// A sign of life rose or fell.
    pub fn presence(&self, sample: &Sample) {
        let key = sample.key_expr().as_str();
        let Some(session) = key.strip_prefix("alive/").filter(|session| session.split('/').all(is_chunk)) else { return };
        let container = session.split('/').count() == 3;
        if session == self.own || !(container || session.split('/').count() == 4) {
            return;
        }
        match sample.kind() {
            SampleKind::Put if container => {
                self.asking.appeared(session);
                self.robot().session_back(session);
                let _ = self.learn.send(session.to_owned());
            }
            SampleKind::Put => {}
            SampleKind::Delete => {
                self.asking.lost(session);
                self.robot().session_ended(session);
            }
        }
        self.changed.notify_all();
    }

    /// Something was announced: of it this small container wants to know which e-stops are open.
    pub fn announced(&self, sample: &Sample, known: &mut HashMap<String, u64>) {
        let chunks: Vec<&str> = sample.key_expr().as_str().split('/').collect();
        if chunks.len() != 6 || !chunks.iter().all(|chunk| is_chunk(chunk)) || chunks[2..5].join("/") == self.own {
            return;
        }
        let (who, payload) = (chunks[2..5].join("/"), sample.payload().to_bytes());
        match chunks[5] {
            "system" => wire::told_estops(&payload).into_iter().for_each(|told| self.learnt(&told)),
            "tally" => {
                let Some(revision) = wire::read_tally(&payload) else { return };
                if self.asking.alive(&who) && known.insert(who.clone(), revision) != Some(revision) {
                    let _ = self.learn.send(who); // something of it may have been missed
                }
            }
            _ => {}
        }
    }

    /// Ask a container which e-stops it has open. Returns whether to ask it again.
    pub fn ask(&self, who: &str) -> bool {
        let get = self.session.get(format!("registry/trade/{who}/*")).target(QueryTarget::All);
        let get = get.consolidation(ConsolidationMode::None).allowed_destination(Locality::Remote);
        let Ok(replies) = get.timeout(Duration::from_secs(2)).wait() else { return false };
        let mut whole = false;
        while let Ok(reply) = replies.recv() {
            let Ok(sample) = reply.result() else { continue };
            let key = sample.key_expr().as_str();
            if key == format!("registry/trade/{who}/system") {
                wire::told_estops(&sample.payload().to_bytes()).into_iter().for_each(|told| self.learnt(&told));
            }
            whole |= key == format!("registry/trade/{who}/tally"); // what it tells last: nothing was cut off
        }
        !whole && self.asking.alive(who)
    }

    // --- e-stops

    /// An order: done the first time, and confirmed each time.
    pub fn ordered(&self, sample: &Sample) {
        let key = sample.key_expr().as_str();
        let Some(identity) = key.strip_prefix("estop/").filter(|identity| is_chunk(identity)) else { return };
        let Some(order) = EstopOrder::read(&sample.payload().to_bytes(), identity) else { return };
        let problem = match (self.first(&order.request), &order.opened) {
            (Some(Some(problem)), _) => problem,
            (Some(None), _) => return, // it is being done: the order comes again
            (None, Some(estop)) => self.open(estop),
            (None, None) => self.clear(&order),
        };
        let put = self.session.put(format!("estop/{}", self.own), wire::estop_confirmed(&order.request, &problem));
        let _ = put.congestion_control(CongestionControl::Drop).priority(Priority::RealTime).express(true).wait();
    }

    /// Others have these open: take the union. One that was cleared here is not opened again.
    fn learnt(&self, told: &[Estop]) {
        for estop in told {
            if self.first(&estop.id).is_none() {
                self.open(estop);
            }
        }
    }

    /// None if this is asked for the first time, and then it is to be done; else how far it is.
    fn first(&self, request: &str) -> Option<Option<String>> {
        let mut requests = self.requests.lock().unwrap();
        let known = requests.get(request).cloned();
        if known.is_none() {
            requests.insert(request.to_owned(), None);
        }
        known
    }

    /// Stop first, write it down then; the arm is at rest when the mutex is free again.
    fn open(&self, estop: &Estop) -> String {
        self.robot().open_estop(estop);
        self.changed.notify_all();
        let noting = self.noting.lock().unwrap();
        let written = if self.robot().is_open(&estop.id) { self.store.write(estop) } else { Ok(()) };
        drop(noting);
        let problem = written.err().map_or(String::new(), |bad| format!("is not written down: {bad}"));
        self.done(&estop.id, problem)
    }

    fn clear(&self, order: &EstopOrder) -> String {
        let noting = self.noting.lock().unwrap();
        self.robot().clear_estops(&order.cleared);
        for id in &order.cleared {
            self.requests.lock().unwrap().insert(id.clone(), Some(String::new())); // what still travels of it opens nothing
        }
        let failed = order.cleared.iter().filter_map(|id| self.store.remove(id).err()).next();
        drop(noting);
        self.done(&order.request, failed.map_or(String::new(), |bad| format!("its note stays: {bad}")))
    }

    fn done(&self, request: &str, problem: String) -> String {
        let mut requests = self.requests.lock().unwrap();
        if requests.len() >= MOST_REQUESTS {
            let open: Vec<String> = self.store.read().into_iter().map(|one| one.id).collect();
            requests.retain(|id, _| open.contains(id));
        }
        requests.insert(request.to_owned(), Some(problem.clone()));
        drop(requests);
        self.announce(&[SYSTEM]);
        problem
    }

    // --- time

    /// Move the arm and end leases, for as long as the process lives.
    pub fn run_arm(&self) {
        let mut next = Instant::now();
        loop {
            if self.robot().tick() {
                self.changed.notify_all();
            }
            next = (next + TICK).max(Instant::now());
            std::thread::sleep(next.saturating_duration_since(Instant::now()));
        }
    }
}

fn answer_of(result: Result<Value>) -> Answer {
    match result {
        Ok(value) => (wire::OK, value),
        Err(Failure(info)) => (wire::ERROR, info),
    }
}

fn names(value: &Value, service: &str) -> Result<Vec<String>> {
    texts(value).ok_or_else(|| Failure::argument(service, "resources", "must be texts"))
}
