//! A container: its state, and the calls that come to it. What else it hears is in `hearing.rs`.

use crate::asking::Asking;
use crate::locks::Holder;
use crate::offers::{find, Effect, Service, SYSTEM};
use crate::once::{Answer, First, Key};
use crate::robot::{self, clock_ns, Robot, TICK};
use crate::store::Store;
use crate::wire::{self, array, field, is_chunk, texts, Call, Failure, Handle, Reply};
use rmpv::Value;
use std::collections::{BTreeMap, HashMap};
use std::io;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::mpsc::Sender;
use std::sync::{Arc, Condvar, Mutex, MutexGuard};
use std::time::{Duration, Instant};
use zenoh::qos::CongestionControl;
use zenoh::sample::Sample;
use zenoh::{Session, Wait};

const MOST_AT_ONCE: usize = 64;
const LOOK: Duration = Duration::from_millis(100);

pub struct Container {
    pub session: Session,
    pub identity: String,
    pub name: String,
    /// `<identity>/<container>/<epoch>`
    pub own: String,
    pub host: String,
    pub robot: Mutex<Robot>,
    pub changed: Condvar,
    pub registry: Mutex<(u64, BTreeMap<String, Vec<u8>>)>,
    /// Requests about e-stops that were heard, and what of each failed; None while it is being done.
    pub requests: Mutex<HashMap<String, Option<String>>>,
    pub store: Store,
    /// One at a time writes or removes notes, so that none outlives its clearing.
    pub noting: Mutex<()>,
    pub asking: Asking,
    pub running: AtomicUsize,
    /// Containers to be asked which e-stops they have open.
    pub learn: Sender<String>,
}

type Result<T> = std::result::Result<T, Failure>;

impl Container {
    pub fn new(session: Session, own: &str, store: Store, random: u64, learn: Sender<String>) -> io::Result<Container> {
        let chunks: Vec<&str> = own.split('/').collect();
        let estops = store.read()?;
        let requests = estops.iter().map(|one| (one.id.clone(), Some(String::new()))).collect();
        let hostname = std::fs::read_to_string("/proc/sys/kernel/hostname");
        Ok(Container {
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
        })
    }

    pub fn reply_key(&self) -> String {
        self.asking.reply_key()
    }

    pub fn robot(&self) -> MutexGuard<'_, Robot> {
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
            return self.answer_apart(call, caller, answer);
        };
        if service.effect == Effect::Read || urgent {
            let answer = answer_of(self.run(service, &call, &caller));
            return self.answer_apart(call, caller, answer);
        }
        let key = (caller.clone(), call.id);
        let first = self.robot().once.begin(&key, &call.reply, &service.label());
        match first {
            First::Ended(answer) => self.answer_apart(call, caller, answer),
            First::Runs => {}
            First::Yes if self.running.load(Ordering::Relaxed) >= MOST_AT_ONCE => {
                self.ended(&call, &key, (wire::BUSY, Value::Nil));
            }
            First::Yes => {
                self.running.fetch_add(1, Ordering::Relaxed);
                let me = self.clone();
                std::thread::spawn(move || {
                    let late = call.expires_ns.is_none_or(|expires_ns| clock_ns() >= expires_ns);
                    let answer =
                        if late { (wire::EXPIRED, Value::Nil) } else { answer_of(me.run(service, &call, &caller)) };
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

    /// On a thread of its own: the next stop does not wait for who does not read its answers.
    fn answer_apart(self: &Arc<Self>, call: Call, caller: String, answer: Answer) {
        let me = self.clone();
        std::thread::spawn(move || me.answer(&call.reply, &caller, call.id, answer));
    }

    fn answer(&self, reply: &str, caller: &str, id: u64, (status, body): Answer) {
        let bytes = Reply { id, status, clock_ns: clock_ns(), body }.bytes();
        let put = self.session.put(format!("reply/{}/{caller}/{reply}", self.identity), bytes);
        let _ = put.congestion_control(CongestionControl::Block).express(true).wait();
        // who asked may be gone
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
            return Err(Failure::argument(
                "trade.acquire",
                "terms",
                "must have a lease_s of 0.1 to 60, a wait_s to 3600",
            ));
        }
        let holder = Holder {
            identity: caller.into(),
            session: call.sessions[0].clone(),
            purpose: field(terms, "purpose").and_then(Value::as_str).unwrap_or_default().into(),
            delegates: field(terms, "delegates").and_then(texts).unwrap_or_default(),
            since: 0.0,
        };
        let (asked, mut robot) = (Instant::now(), self.robot());
        let waiter = robot.queue(names, holder, terms, call)?;
        let token = loop {
            if waiter == 0 {
                break Value::Nil; // it has all of them already
            }
            let refused = match robot.granted(waiter, Duration::from_secs_f64(lease_s), &call.calls) {
                Ok(token) => break token.value(),
                Err(refused) => refused,
            };
            let left = Duration::from_secs_f64(wait_s).saturating_sub(asked.elapsed());
            let unwanted =
                robot.once.cancelled(&(caller.to_owned(), call.id)) || robot.all_there(&call.sessions).is_err();
            if left.is_zero() || unwanted {
                robot.leave_queue(waiter);
                return Err(refused);
            }
            robot = self.changed.wait_timeout(robot, left.min(LOOK)).unwrap().0;
        };
        let granted = if token.is_nil() { array::<Value>([]) } else { array(names.iter().map(String::as_str)) };
        let waited_s = asked.elapsed().as_secs_f64();
        Ok(wire::map([("token", token), ("resources", granted), ("waited_s", waited_s.into())]))
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

#[cfg(test)]
mod tests {
    use super::*;
    use std::sync::mpsc::{channel, RecvTimeoutError};
    use zenoh::Config;

    const OWN: &str = "peer/peer/0123456789abcdef";
    const PATIENCE: Duration = Duration::from_secs(30);

    fn alone() -> Session {
        let mut config = Config::default();
        for (key, value) in [("listen/endpoints", "[]"), ("scouting/multicast/enabled", "false")] {
            config.insert_json5(key, value).unwrap();
        }
        zenoh::open(config).wait().unwrap()
    }

    fn stop(id: u64, service: &str, args: Value) -> Vec<u8> {
        let (reply, sessions) = ("suite/r".into(), vec!["anna/suite/e/1".into()]);
        let (chain, calls, tokens) = (vec![], vec![], vec![]);
        Call { id, service: service.into(), reply, sessions, expires_ns: None, chain, args, calls, tokens }.bytes()
    }

    #[test]
    fn no_stop_waits_for_who_does_not_read_its_answers() {
        let session = alone();
        let folder = std::env::temp_dir().join(format!("trade-peer-test-{}", std::process::id()));
        let (learn, _learning) = channel();
        let container = Arc::new(Container::new(session.clone(), OWN, Store(folder.clone()), 1, learn).unwrap());
        std::fs::remove_dir_all(folder).unwrap();
        let (answered, answers) = channel();
        let (go_on, held) = channel::<()>();
        let held = Mutex::new(held);
        let reading = session.declare_subscriber("reply/**").callback(move |_| {
            let _ = answered.send(());
            let _ = held.lock().unwrap().recv(); // until who may go on is dropped
        });
        let _reading = reading.wait().unwrap();
        let stops = session.declare_subscriber(format!("stop/*/{OWN}/**")).wait().unwrap();

        let cancelled = Value::Array(vec![7.into(), "peer.turn".into(), 1.0.into()]);
        for (service, place, args) in [
            ("cancel", "trade/system", cancelled),
            ("fly", "trade/system", array::<Value>([])),
            ("halt", "peer/arm", array::<Value>([])),
        ] {
            session.put(format!("stop/anna/{OWN}/{place}"), stop(1, service, args)).wait().unwrap();
            let (sample, me) = (stops.recv().unwrap(), container.clone());
            let (done, ended) = channel::<()>();
            std::thread::spawn(move || {
                me.called(&sample);
                drop(done);
            });
            assert_eq!(ended.recv_timeout(PATIENCE), Err(RecvTimeoutError::Disconnected), "{service} waits");
            answers.recv_timeout(PATIENCE).expect("it is answered, to who does not read");
        }
        assert_eq!(container.robot().resources[robot::ARM].stops, 1);
        drop(go_on);
    }
}
