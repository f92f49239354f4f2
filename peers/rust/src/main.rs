//! A small TRADE container: a simulated arm that turns, and a relay that calls others. Passes `trade conformance`.

mod asking;
mod container;
mod hearing;
mod locks;
mod offers;
mod once;
mod robot;
mod store;
#[cfg(test)]
mod vectors;
mod wire;

use container::Container;
use std::collections::HashMap;
use std::env;
use std::error::Error;
use std::fs;
use std::hash::{BuildHasher, RandomState};
use std::path::{Path, PathBuf};
use std::sync::mpsc::channel;
use std::sync::Arc;
use std::time::Duration;
use store::Store;
use zenoh::sample::{Locality, Sample};
use zenoh::{Config, Session, Wait};

const BEAT: Duration = Duration::from_secs(2);
const AGAIN: Duration = Duration::from_millis(100);
const CALLS_WAITING: usize = 4096;

fn main() {
    std::panic::set_hook(Box::new(|why| {
        eprintln!("trade-peer: {why}");
        std::process::abort(); // one that has lost a thread is to be gone: its sign of life falls
    }));
    if let Err(why) = run() {
        eprintln!("trade-peer: {why}");
        std::process::exit(1);
    }
}

fn run() -> Result<(), Box<dyn Error + Send + Sync>> {
    let [system, identity, name] = [needed("TRADE_SYSTEM")?, needed("TRADE_IDENTITY")?, needed("TRADE_CONTAINER")?];
    if env::var_os("TRADE_TLS").is_some() {
        return Err(
            "TRADE_TLS is set, and this example has no certificates: it joins systems of its own host only".into()
        );
    }
    for chunk in [&system, &identity, &name] {
        if !wire::is_chunk(chunk) {
            return Err(format!("{chunk:?} is no name; use letters, digits, . _ - (at most 80)").into());
        }
    }
    let state = PathBuf::from(needed("TRADE_STATE_DIR")?).join(&system).join(&name).join("estops");
    let own = format!("{identity}/{name}/{:016x}", random());
    let session = open(&system, &needed("TRADE_CONNECT")?, &needed("TRADE_CREDENTIALS")?)?;
    let (learn, to_learn) = channel::<String>();
    let container = Arc::new(Container::new(session.clone(), &own, Store(state), random(), learn)?);

    // Calls first, then the answers to what is offered, then the sign of life: who hears of a service can call it.
    let served = |kind: &str| session.declare_subscriber(format!("{kind}/*/{own}/**"));
    let calls = served("call").with(zenoh::handlers::FifoChannel::new(CALLS_WAITING)).wait()?;
    let stops = served("stop").with(zenoh::handlers::FifoChannel::new(CALLS_WAITING)).wait()?;
    let orders = session.declare_subscriber("estop/*").wait()?;
    let replies = session.declare_subscriber(container.reply_key()).wait()?;
    let questions = session.declare_queryable(format!("registry/*/{own}/*")).wait()?;
    let told = session.declare_subscriber("registry/trade/**").allowed_origin(Locality::Remote).wait()?;
    each("stops", &container, move || stops.recv(), Container::called_now);
    each("orders", &container, move || orders.recv(), |container, order| container.ordered(&order));
    each("calls", &container, move || calls.recv(), Container::called_now);
    each("replies", &container, move || replies.recv(), |container, reply| container.answered(&reply));
    each("questions", &container, move || questions.recv(), |container, query| container.asked(&query));
    let mut known = HashMap::new();
    each("told", &container, move || told.recv(), move |container, sample| container.announced(&sample, &mut known));
    each(
        "learning",
        &container,
        move || to_learn.recv(),
        |container, who: String| {
            if !container.ask(&who) {
                std::thread::sleep(AGAIN);
                container.ask_later(who); // behind the others
            }
        },
    );
    let arm = container.clone();
    std::thread::Builder::new().name("arm".into()).spawn(move || arm.run_arm())?;

    container.announce_all();
    let _sign = session.liveliness().declare_token(format!("alive/{own}")).wait()?;
    let signs = session.liveliness().declare_subscriber("alive/**").history(true).wait()?;
    each("signs", &container, move || signs.recv(), |container, sign: Sample| container.presence(&sign));
    loop {
        std::thread::sleep(BEAT);
        container.beat();
    }
}

impl Container {
    fn called_now(self: &Arc<Self>, sample: Sample) {
        self.called(&sample);
    }
}

/// A thread that deals with one kind of thing, one after the other, until the session is closed.
fn each<T, E>(
    name: &str,
    container: &Arc<Container>,
    mut next: impl FnMut() -> Result<T, E> + Send + 'static,
    mut with: impl FnMut(&Arc<Container>, T) + Send + 'static,
) {
    let container = container.clone();
    let dealing = move || {
        while let Ok(one) = next() {
            with(&container, one);
        }
    };
    std::thread::Builder::new().name(name.into()).spawn(dealing).expect("a thread can be started");
}

/// A session on the loopback interface, as docs/wire-protocol.md says under "Links".
fn open(system: &str, connect: &str, credentials: &str) -> Result<Session, Box<dyn Error + Send + Sync>> {
    let (user, password) = credentials.split_once(':').ok_or("TRADE_CREDENTIALS must be user:password")?;
    let endpoints: Vec<String> = connect.split(',').map(|one| format!("{one:?}")).collect();
    let allowed = allowed_file(credentials)?; // of who dials us; there while the session opens
    let mut config = Config::default();
    let settings = [
        ("id", format!("\"{:x}{:014x}ff\"", 1 + random() % 15, random() >> 8)), // a great one: it dials, others do not
        ("mode", "\"peer\"".into()),
        ("namespace", format!("{system:?}")),
        ("listen/endpoints", "[\"tcp/127.0.0.1:0\"]".into()),
        ("connect/endpoints", format!("[{}]", endpoints.join(","))),
        ("connect/timeout_ms", "-1".into()),
        ("connect/exit_on_failure", "false".into()),
        ("connect/retry", "{period_init_ms: 200, period_max_ms: 1000, period_increase_factor: 2}".into()),
        ("scouting/multicast/enabled", "false".into()),
        ("scouting/gossip/autoconnect", "{router: ['peer'], peer: ['router', 'peer']}".into()),
        (
            "scouting/gossip/autoconnect_strategy",
            "{peer: {to_router: 'always', to_peer: 'greater-zid'}, router: {to_peer: 'always'}}".into(),
        ),
        ("transport/auth/usrpwd/user", format!("{user:?}")),
        ("transport/auth/usrpwd/password", format!("{password:?}")),
        ("transport/auth/usrpwd/dictionary_file", format!("{:?}", allowed.0.display().to_string())),
        ("transport/link/tx/lease", "2000".into()),
        ("transport/link/tx/keep_alive", "4".into()),
        ("transport/link/tx/queue/congestion_control/block/wait_before_close", "1000000".into()),
    ];
    for (key, value) in settings {
        config.insert_json5(key, &value)?;
    }
    zenoh::open(config).wait()
}

struct Removed(PathBuf);

impl Drop for Removed {
    fn drop(&mut self) {
        let _ = fs::remove_file(&self.0);
    }
}

/// The pair in the one form the transport takes it: a file, readable by this user alone.
fn allowed_file(credentials: &str) -> std::io::Result<Removed> {
    use std::io::Write;
    let path = Path::new(&env::temp_dir()).join(format!("trade-peer-{:016x}", random()));
    let mut options = fs::OpenOptions::new();
    options.write(true).create_new(true);
    #[cfg(unix)]
    std::os::unix::fs::OpenOptionsExt::mode(&mut options, 0o600);
    let removed = Removed(path);
    options.open(&removed.0)?.write_all(format!("{credentials}\n").as_bytes())?;
    Ok(removed)
}

fn needed(name: &str) -> Result<String, String> {
    env::var(name).map_err(|_| format!("{name} is not set; docs/wire-protocol.md says what it is"))
}

/// Random enough for names: the standard library seeds its hashers from the operating system.
fn random() -> u64 {
    RandomState::new().hash_one(std::process::id())
}
