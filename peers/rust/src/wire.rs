//! What travels: keys, messages, errors. docs/wire-protocol.md says the same in prose, docs/wire-vectors.json in bytes.

use rmpv::Value;

pub const VERSION: u64 = 1;
const DEEPEST: usize = 100;
const MOST_BYTES: usize = 65 << 20;

/// Statuses of a reply.
pub const OK: u64 = 0;
pub const ERROR: u64 = 1;
pub const BUSY: u64 = 2;
pub const EXPIRED: u64 = 3;
pub const GONE: u64 = 4;
pub const PROGRESS: u64 = 5;

/// Whether a text can stand as one chunk of a key.
pub fn is_chunk(text: &str) -> bool {
    let plain = |c: char| c.is_ascii_alphanumeric() || "_.@:-".contains(c);
    (1..=80).contains(&text.len()) && !text.starts_with('@') && text.chars().all(plain)
}

/// One MessagePack value and nothing after it; None for anything else.
pub fn decode(payload: &[u8]) -> Option<Value> {
    if payload.len() > MOST_BYTES {
        return None;
    }
    let mut rest = payload;
    let value = rmpv::decode::read_value_with_max_depth(&mut rest, DEEPEST).ok()?;
    rest.is_empty().then_some(value)
}

pub fn encode(value: &Value) -> Vec<u8> {
    let mut bytes = Vec::new();
    rmpv::encode::write_value(&mut bytes, value).expect("a Vec takes all");
    bytes
}

pub fn array<T: Into<Value>>(items: impl IntoIterator<Item = T>) -> Value {
    Value::Array(items.into_iter().map(Into::into).collect())
}

pub fn map<const N: usize>(fields: [(&str, Value); N]) -> Value {
    Value::Map(fields.into_iter().map(|(name, value)| (name.into(), value)).collect())
}

/// A field of a map.
pub fn field<'a>(value: &'a Value, name: &str) -> Option<&'a Value> {
    value.as_map()?.iter().find(|(key, _)| key.as_str() == Some(name)).map(|(_, value)| value)
}

pub fn texts(value: &Value) -> Option<Vec<String>> {
    value.as_array()?.iter().map(|one| Some(one.as_str()?.to_owned())).collect()
}

/// A message of this version as the array that it is; later versions append to it, so it may be longer.
fn fields(payload: &[u8], least: usize) -> Option<Vec<Value>> {
    any_fields(payload, least).filter(|fields| fields[0].as_u64() == Some(VERSION))
}

/// Of whatever version.
fn any_fields(payload: &[u8], least: usize) -> Option<Vec<Value>> {
    match decode(payload)? {
        Value::Array(fields) if fields.len() >= least && fields[0].as_u64() >= Some(1) => Some(fields),
        _ => None,
    }
}

/// A lock's grant: the epoch of the container that gave it, and its number there.
#[derive(Clone, Debug, PartialEq)]
pub struct Token {
    pub epoch: String,
    pub number: u64,
}

impl Token {
    pub fn read(value: &Value) -> Option<Token> {
        let parts = value.as_array()?;
        Some(Token { epoch: parts.first()?.as_str()?.to_owned(), number: parts.get(1)?.as_u64()? })
    }

    pub fn value(&self) -> Value {
        Value::Array(vec![self.epoch.as_str().into(), self.number.into()])
    }
}

#[derive(Clone, Debug)]
pub struct Call {
    pub id: u64,
    pub service: String,
    /// `<container>/<channel>` of the reply key.
    pub reply: String,
    /// The caller's own session first, then those on whose behalf it asks.
    pub sessions: Vec<String>,
    /// In the callee's clock.
    pub expires_ns: Option<i64>,
    pub chain: Vec<String>,
    pub args: Value,
    /// Ids of the calls that led to it.
    pub calls: Vec<u64>,
    pub tokens: Vec<Token>,
}

impl Call {
    pub fn read(payload: &[u8]) -> Option<Call> {
        let fields = fields(payload, 8)?;
        let mut sessions = vec![fields[4].as_str()?.to_owned()];
        let (mut calls, mut tokens) = (Vec::new(), Vec::new());
        match fields.get(8) {
            None | Some(Value::Nil) => {}
            Some(behalf) => {
                let parts = behalf.as_array()?;
                sessions.extend(parts.first().map_or(Some(vec![]), texts)?);
                let ids = parts.get(1).map_or(Some(&[][..]), |ids| ids.as_array().map(Vec::as_slice))?;
                calls = ids.iter().map(Value::as_u64).collect::<Option<_>>()?;
                let shown = parts.get(2).map_or(Some(&[][..]), |ids| ids.as_array().map(Vec::as_slice))?;
                tokens = shown.iter().map(Token::read).collect::<Option<_>>()?;
            }
        }
        let expires_ns = match &fields[5] {
            Value::Nil => None,
            some => Some(some.as_i64()?),
        };
        let reply = fields[3].as_str()?;
        let (container, channel) = reply.split_once('/')?;
        if !(is_chunk(container) && is_chunk(channel)) || !(fields[7].is_array() || fields[7].is_map()) {
            return None;
        }
        Some(Call {
            id: fields[1].as_i64().and_then(|id| u64::try_from(id).ok())?,
            service: fields[2].as_str()?.to_owned(),
            reply: reply.to_owned(),
            sessions,
            expires_ns,
            chain: texts(&fields[6])?,
            args: fields[7].clone(),
            calls,
            tokens,
        })
    }

    pub fn bytes(&self) -> Vec<u8> {
        let behalf = [
            array(self.sessions[1..].iter().map(String::as_str)),
            array(self.calls.iter().copied()),
            Value::Array(self.tokens.iter().map(Token::value).collect()),
        ];
        encode(&Value::Array(vec![
            VERSION.into(),
            self.id.into(),
            self.service.as_str().into(),
            self.reply.as_str().into(),
            self.sessions[0].as_str().into(),
            self.expires_ns.map_or(Value::Nil, Value::from),
            array(self.chain.iter().map(String::as_str)),
            self.args.clone(),
            Value::Array(behalf.into()),
        ]))
    }
}

#[derive(Clone, Debug)]
pub struct Reply {
    pub id: u64,
    pub status: u64,
    pub clock_ns: i64,
    pub body: Value,
}

impl Reply {
    /// What may travel; the numbers above are put by nobody.
    pub fn read(payload: &[u8]) -> Option<Reply> {
        let fields = fields(payload, 5)?;
        let status = fields[2].as_u64().filter(|status| *status <= PROGRESS)?;
        let body = fields[4].clone();
        Some(Reply { id: fields[1].as_u64()?, status, clock_ns: fields[3].as_i64()?, body })
    }

    pub fn bytes(&self) -> Vec<u8> {
        let head = [VERSION.into(), self.id.into(), self.status.into(), self.clock_ns.into()];
        encode(&Value::Array(head.into_iter().chain([self.body.clone()]).collect()))
    }
}

pub fn tally(revision: u64) -> Vec<u8> {
    encode(&array([VERSION, revision]))
}

pub fn read_tally(payload: &[u8]) -> Option<u64> {
    fields(payload, 2)?[1].as_u64()
}

#[derive(Clone, Debug, PartialEq)]
pub struct Estop {
    pub id: String,
    pub by: String,
    pub reason: String,
    pub at: f64,
    /// `<identity>/<container>` of the container that told of it; empty: the order itself was heard.
    pub told_by: String,
}

impl Estop {
    /// What stands in every version, id and session, and what is understood of the rest.
    pub fn read(value: &Value) -> Option<Estop> {
        let parts = value.as_array().filter(|parts| parts.len() >= 2)?;
        let id = parts[0].as_str().filter(|id| is_chunk(id))?.to_owned();
        let by = parts[1].as_str().filter(|by| by.chars().count() <= 300)?.to_owned();
        let reason = parts.get(2).and_then(Value::as_str).unwrap_or("").chars().take(500).collect();
        let at = parts.get(3).and_then(Value::as_f64).filter(|at| at.is_finite()).unwrap_or(0.0);
        let told_by = parts.get(4).and_then(Value::as_str).unwrap_or("").chars().take(300).collect();
        Some(Estop { id, by, reason, at, told_by })
    }

    /// The same, learnt from the entry of a container: only its giver's identity speaks for itself.
    fn told(self, teller: &str) -> Estop {
        let speaks_for_itself = self.by.split('/').next() == teller.split('/').next();
        let told_by = if speaks_for_itself { "" } else { teller.rsplit_once('/').map_or(teller, |(who, _)| who) };
        let told_by = told_by.to_owned();
        Estop { told_by, ..self }
    }

    pub fn value(&self) -> Value {
        let [id, by, reason, told_by] =
            [&self.id, &self.by, &self.reason, &self.told_by].map(|text| Value::from(text.as_str()));
        Value::Array(vec![id, by, reason, self.at.into(), told_by])
    }
}

pub struct EstopOrder {
    pub request: String,
    pub opened: Option<Estop>,
    pub cleared: Vec<String>,
}

impl EstopOrder {
    /// An order of that identity: to stop, of any version; to clear, of this one. None if it is none, or in the name
    /// of another.
    pub fn read(payload: &[u8], identity: &str) -> Option<EstopOrder> {
        let fields = any_fields(payload, 2)?;
        let request = fields[1].as_str().filter(|request| is_chunk(request))?.to_owned();
        if let Some(estop) = fields.get(2).filter(|estop| !estop.is_nil()) {
            let opened =
                Estop::read(estop).filter(|one| one.id == request && one.by.starts_with(&format!("{identity}/")))?;
            return Some(EstopOrder { request, opened: Some(opened), cleared: vec![] });
        }
        let cleared = fields.get(3).map_or(Some(vec![]), texts)?;
        let plain = cleared.len() <= 64 && cleared.iter().all(|id| is_chunk(id));
        (plain && fields[0].as_u64() == Some(VERSION)).then_some(EstopOrder { request, opened: None, cleared })
    }
}

pub fn estop_confirmed(request: &str, problem: &str) -> Vec<u8> {
    encode(&Value::Array(vec![VERSION.into(), request.into(), problem.into()]))
}

/// The open e-stops that a container's own entry tells of, in whatever version. The teller is its address.
pub fn told_estops(payload: &[u8], teller: &str) -> Option<Vec<Estop>> {
    let entry = decode(payload)?;
    let estop = |told: &Value| Some(Estop::read(told)?.told(teller));
    field(&entry, "estops").map_or(Some(vec![]), |told| told.as_array()?.iter().map(estop).collect())
}

/// A service of one boot of one container: what a handle says.
#[derive(Clone, Debug)]
pub struct Handle {
    /// `<identity>/<container>/<epoch>`
    pub address: String,
    pub domain: String,
    pub provider: String,
    pub name: String,
}

impl Handle {
    pub fn read(value: &Value) -> Option<Handle> {
        let Value::Ext(1, data) = value else { return None };
        let parts = decode(data)?;
        let parts = parts.as_array().filter(|parts| parts.len() == 4)?;
        let address = texts(&parts[0]).filter(|chunks| chunks.len() == 3)?;
        let names = texts(&Value::Array(parts[1..].to_vec()))?;
        if !address.iter().chain(&names[..2]).all(|chunk| is_chunk(chunk)) {
            return None;
        }
        let [domain, provider, name] = <[String; 3]>::try_from(names).ok()?;
        Some(Handle { address: address.join("/"), domain, provider, name })
    }
}

/// An error on its way to the caller: an ErrorInfo.
#[derive(Clone, Debug)]
pub struct Failure(pub Value);

impl Failure {
    /// One of TRADE's own, by its name and its fields; Python callers catch it as that.
    pub fn new<const N: usize>(name: &str, message: impl Into<String>, fields: [(&str, Value); N]) -> Failure {
        Failure(map([
            ("type", format!("trade.errors:{name}").into()),
            ("message", message.into().into()),
            ("fields", map(fields)),
            ("traceback", "".into()),
        ]))
    }

    pub fn argument(service: &str, argument: &str, problem: &str) -> Failure {
        let fields = [("service", service.into()), ("argument", argument.into()), ("problem", problem.into())];
        Failure::new("InvalidArgument", format!("{service}: argument {argument:?} {problem}"), fields)
    }

    pub fn service_gone(service: &str, reason: &str) -> Failure {
        let fields = [("service", service.into()), ("reason", reason.into())];
        Failure::new("ServiceGone", format!("{service}: {reason}"), fields)
    }

    pub fn stopped_motion(reason: &str) -> Failure {
        let fields = [("device", "peer.arm".into()), ("reason", reason.into())];
        Failure::new("MotionStopped", format!("the arm stopped before its goal: {reason}"), fields)
    }

    pub fn cancelled(service: &str) -> Failure {
        Failure::new("Cancelled", format!("the call of {service} was cancelled"), [("service", service.into())])
    }

    pub fn outcome_unknown(service: &str) -> Failure {
        let fields = [("service", service.into()), ("deadline_s", 0.0.into())];
        Failure::new("OutcomeUnknown", format!("what became of {service} is not known any more"), fields)
    }
}
