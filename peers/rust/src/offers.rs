//! What is offered: the services, how they are described, and the arguments that fit them.

use crate::wire::{array, map, Failure, VERSION};
use rmpv::Value;

#[derive(Clone, Copy, PartialEq)]
pub enum Effect {
    Read,
    Actuate,
    Stop,
}

pub struct Service {
    pub provider: (&'static str, &'static str),
    pub name: &'static str,
    pub effect: Effect,
    /// Name, JSON Schema type (empty: anything) and whether it must be given.
    pub parameters: &'static [(&'static str, &'static str, bool)],
    pub uses: &'static [&'static str],
    pub doc: &'static str,
}

pub const SYSTEM: (&str, &str) = ("trade", "system");
pub const ARM: (&str, &str) = ("peer", "arm");
pub const RELAY: (&str, &str) = ("peer", "relay");
pub const PROVIDERS: [(&str, &str); 3] = [SYSTEM, ARM, RELAY];

macro_rules! service {
    ($provider:ident $name:literal $effect:ident ($($parameter:expr),*) uses $uses:expr, $doc:literal) => {
        Service {
            provider: $provider,
            name: $name,
            effect: Effect::$effect,
            parameters: &[$($parameter),*],
            uses: &$uses,
            doc: $doc,
        }
    };
}

pub const SERVICES: [Service; 13] = [
    service!(ARM "echo" Read (("value", "", true)) uses [], "The same again."),
    service!(ARM "angle" Read () uses [], "Where it stands, in rad."),
    service!(ARM "turns" Read () uses [], "How many turns have begun."),
    service!(ARM "turn" Actuate (("angle_rad", "number", true)) uses ["peer.arm"], "Go there at 1 rad/s."),
    service!(ARM "halt" Stop () uses ["peer.arm"], "Stand still."),
    service!(RELAY "relay" Actuate (("service", "object", true), ("resources", "array", true), ("args", "array", true))
        uses [], "Call a service of another container, under a lock of these resources of it if there are any."),
    service!(SYSTEM "clock" Read () uses [], "Monotonic clock of this container, in nanoseconds."),
    service!(SYSTEM "acquire" Actuate (("resources", "array", true), ("terms", "object", true)) uses [],
        "Take all of these for the calling session."),
    service!(SYSTEM "renew" Stop (("grants", "array", true)) uses [], "Begin leases anew; why those over are over."),
    service!(SYSTEM "release" Stop (("grant", "integer", true), ("lost", "string", false)) uses [], "Give it back."),
    service!(SYSTEM "locks" Read () uses [], "What is locked here, by whom, and who waits for it."),
    service!(SYSTEM "break_lock" Stop (("grant", "integer", true), ("reason", "string", true)) uses [],
        "Take a lock away from its owner."),
    service!(SYSTEM "resume" Actuate (("resources", "array", true)) uses [], "Let these move again after a stop."),
];

pub fn find(domain: &str, provider: &str, name: &str) -> Option<&'static Service> {
    SERVICES.iter().find(|one| one.provider == (domain, provider) && one.name == name)
}

impl Service {
    pub fn label(&self) -> String {
        format!("{}.{}", self.provider.0, self.name)
    }

    /// The arguments in the order of the parameters, nil for what is left out; or why they do not fit.
    pub fn bind(&self, given: &Value) -> Result<Vec<Value>, Failure> {
        let wrong = |name: &str, problem: &str| Err(Failure::argument(&self.label(), name, problem));
        let mut bound = vec![None; self.parameters.len()];
        match given {
            Value::Array(values) if values.len() <= bound.len() => {
                bound.iter_mut().zip(values).for_each(|(place, value)| *place = Some(value.clone()));
            }
            Value::Array(_) => return wrong("", "there are too many"),
            Value::Map(named) => {
                for (name, value) in named {
                    let name = name.as_str().unwrap_or_default();
                    match self.parameters.iter().position(|(parameter, ..)| *parameter == name) {
                        Some(at) => bound[at] = Some(value.clone()),
                        None => return wrong(name, "is none of its parameters"),
                    }
                }
            }
            _ => return wrong("", "are neither in order nor by name"),
        }
        for ((name, kind, required), value) in self.parameters.iter().zip(&bound) {
            match value {
                None if *required => return wrong(name, "is missing"),
                Some(value) if !fits(value, kind) => return wrong(name, &format!("is no {kind}")),
                Some(value) if value.as_f64().is_some_and(|number| !number.is_finite()) && *kind == "number" => {
                    return wrong(name, "is not finite")
                }
                _ => {}
            }
        }
        Ok(bound.into_iter().map(|value| value.unwrap_or(Value::Nil)).collect())
    }

    fn info(&self) -> Value {
        let effect = match self.effect {
            Effect::Read => "read",
            Effect::Actuate => "actuate",
            Effect::Stop => "stop",
        };
        let schema = |kind: &str| if kind.is_empty() { map([]) } else { map([("type", kind.into())]) };
        let properties = self.parameters.iter().map(|(name, kind, _)| (Value::from(*name), schema(kind))).collect();
        let required = self.parameters.iter().filter(|one| one.2).map(|(name, ..)| *name);
        let parameter = |(name, _, required): &(&str, &str, bool)| {
            Value::Array(vec![(*name).into(), (*required).into(), false.into(), false.into()])
        };
        let names: Vec<&str> = self.parameters.iter().map(|(name, ..)| *name).collect();
        map([
            ("name", self.name.into()),
            ("signature", format!("{}({})", self.name, names.join(", ")).into()),
            ("doc", self.doc.into()),
            ("effect", effect.into()),
            ("uses", array(self.uses.iter().copied())),
            ("parameters", Value::Array(self.parameters.iter().map(parameter).collect())),
            (
                "arguments_schema",
                map([
                    ("type", "object".into()),
                    ("properties", Value::Map(properties)),
                    ("required", array(required)),
                    ("additionalProperties", false.into()),
                ]),
            ),
            ("result_schema", map([])),
        ])
    }
}

fn fits(value: &Value, kind: &str) -> bool {
    match kind {
        "number" => value.is_number(),
        "integer" => value.as_i64().is_some(),
        "string" => value.is_str(),
        "array" => value.is_array(),
        "object" => value.is_map() || value.is_ext(),
        _ => true,
    }
}

/// The registry entry of a provider.
pub fn entry(provider: (&str, &str), revision: u64, host: &str, estops: Value) -> Value {
    let services = SERVICES.iter().filter(|one| one.provider == provider).map(Service::info);
    map([
        ("v", VERSION.into()),
        ("revision", revision.into()),
        ("groups", array([provider.0])),
        ("kind", "Peer".into()),
        ("host", host.into()),
        ("pid", std::process::id().into()),
        ("services", Value::Array(services.collect())),
        ("estops", estops),
    ])
}
