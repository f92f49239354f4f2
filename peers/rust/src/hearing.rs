//! What a container hears and tells beside calls: what is offered, who is there, which e-stops are open.

use crate::container::Container;
use crate::offers::{entry, PROVIDERS, SYSTEM};
use crate::wire::{self, array, is_chunk, Estop, EstopOrder};
use rmpv::Value;
use std::collections::HashMap;
use std::sync::Arc;
use std::time::Duration;
use zenoh::qos::{CongestionControl, Priority};
use zenoh::query::{ConsolidationMode, Query, QueryTarget};
use zenoh::sample::{Locality, Sample, SampleKind};
use zenoh::Wait;

const MOST_REQUESTS: usize = 4096;

impl Container {
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
        let (revision, entries) = self.registry.lock().unwrap().clone(); // nobody waits for who asks
        for (key, bytes) in entries.into_iter().chain([(self.tally_key(), wire::tally(revision))]) {
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
        let Some(session) = key.strip_prefix("alive/").filter(|session| session.split('/').all(is_chunk)) else {
            return;
        };
        let container = session.split('/').count() == 3;
        if session == self.own || !(container || session.split('/').count() == 4) {
            return;
        }
        match sample.kind() {
            SampleKind::Put if container => {
                self.asking.appeared(session);
                self.robot().session_back(session);
                self.ask_later(session.to_owned());
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
            "tally" => {
                let Some(revision) = wire::read_tally(&payload) else { return };
                if self.asking.alive(&who) && known.insert(who.clone(), revision) != Some(revision) {
                    self.ask_later(who); // something of it may have been missed
                }
            }
            _ => wire::told_estops(&payload, &who).into_iter().for_each(|told| self.learnt(&told)),
        }
    }

    pub fn ask_later(&self, who: String) {
        let _ = self.learn.send(who); // who learns lives as long as the process
    }

    /// Ask a container which e-stops it has open. Returns whether that is known then, or it is not there any more.
    pub fn ask(&self, who: &str) -> bool {
        let get = self.session.get(format!("registry/trade/{who}/*")).target(QueryTarget::All);
        let get = get.consolidation(ConsolidationMode::None).allowed_destination(Locality::Remote);
        let Ok(replies) = get.timeout(Duration::from_secs(2)).wait() else { return !self.asking.alive(who) };
        let mut whole = false;
        while let Ok(reply) = replies.recv() {
            let Ok(sample) = reply.result() else { continue };
            let key = sample.key_expr().as_str();
            if key == format!("registry/trade/{who}/tally") {
                whole = true; // what it tells last: nothing was cut off
            } else {
                let told = wire::told_estops(&sample.payload().to_bytes(), who);
                told.into_iter().for_each(|told| self.learnt(&told));
            }
        }
        whole || !self.asking.alive(who)
    }

    // --- e-stops

    /// An order: done the first time, and confirmed each time. Everything stops before anything else is done.
    pub fn ordered(self: &Arc<Self>, sample: &Sample) {
        let key = sample.key_expr().as_str();
        let Some(identity) = key.strip_prefix("estop/").filter(|identity| is_chunk(identity)) else { return };
        let Some(order) = EstopOrder::read(&sample.payload().to_bytes(), identity) else { return };
        match self.first(&order.request) {
            Some(Some(problem)) => return self.confirm(&order.request, &problem),
            Some(None) => return, // it is being done: the order comes again
            None => order.opened.iter().for_each(|estop| self.stop_all(estop)),
        }
        let me = self.clone(); // the next order does not wait for a disk, or for who does not read
        std::thread::spawn(move || {
            let problem = match &order.opened {
                Some(estop) => me.note(estop),
                None => me.clear(&order),
            };
            me.confirm(&order.request, &problem);
        });
    }

    fn confirm(&self, request: &str, problem: &str) {
        let put = self.session.put(format!("estop/{}", self.own), wire::estop_confirmed(request, problem));
        let _ = put.congestion_control(CongestionControl::Drop).priority(Priority::RealTime).express(true).wait();
    }

    /// Others have these open: take the union. One that was cleared here is not opened again.
    fn learnt(&self, told: &[Estop]) {
        for estop in told {
            if self.first(&estop.id).is_none() {
                self.stop_all(estop);
                self.note(estop);
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

    /// The arm is at rest when the mutex is free again.
    fn stop_all(&self, estop: &Estop) {
        self.robot().open_estop(estop);
        self.changed.notify_all();
    }

    /// Write it down unless it is cleared meanwhile, and tell of it. Returns what went wrong.
    fn note(&self, estop: &Estop) -> String {
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
            self.requests.lock().unwrap().insert(id.clone(), Some(String::new()));
            // what still travels of it opens nothing
        }
        let failed = order.cleared.iter().filter_map(|id| self.store.remove(id).err()).next();
        drop(noting);
        self.done(&order.request, failed.map_or(String::new(), |bad| format!("its note stays: {bad}")))
    }

    fn done(&self, request: &str, problem: String) -> String {
        let mut requests = self.requests.lock().unwrap();
        if requests.len() >= MOST_REQUESTS {
            let robot = self.robot();
            requests.retain(|id, how_far| how_far.is_none() || robot.is_open(id));
        }
        requests.insert(request.to_owned(), Some(problem.clone()));
        drop(requests);
        self.announce(&[SYSTEM]);
        problem
    }
}
