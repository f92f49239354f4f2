//! The bytes of docs/wire-vectors.json mean here what they mean everywhere.

use crate::wire::{self, Call, Estop, EstopOrder, Handle, Reply, Token};
use rmpv::Value;
use serde_json::{json, Value as Json};

fn vectors(part: &str) -> Vec<Json> {
    let all: Json = serde_json::from_str(include_str!("../../../docs/wire-vectors.json")).unwrap();
    all[part].as_array().unwrap().clone()
}

fn bytes(hex: &Json) -> Vec<u8> {
    let digits = hex["hex"].as_str().unwrap();
    (0..digits.len()).step_by(2).map(|at| u8::from_str_radix(&digits[at..at + 2], 16).unwrap()).collect()
}

fn hex(data: &[u8]) -> String {
    data.iter().map(|byte| format!("{byte:02x}")).collect()
}

fn meaning(value: &Value) -> Json {
    match value {
        Value::Nil => Json::Null,
        Value::Boolean(is) => json!(is),
        Value::Integer(number) => number.as_i64().map_or_else(|| json!(number.as_u64()), |number| json!(number)),
        Value::F32(number) => json!(number),
        Value::F64(number) => json!(number),
        Value::String(text) => json!(text.as_str().unwrap()),
        Value::Binary(data) => json!({ "$bytes": hex(data) }),
        Value::Array(items) => Json::Array(items.iter().map(meaning).collect()),
        Value::Map(fields) if fields.iter().all(|(name, _)| name.is_str()) => {
            fields.iter().map(|(name, value)| (name.as_str().unwrap().to_owned(), meaning(value))).collect()
        }
        Value::Map(fields) => {
            json!({ "$map": fields.iter().map(|(k, v)| [meaning(k), meaning(v)]).collect::<Vec<_>>() })
        }
        Value::Ext(kind, data) => json!({ "$extension": [kind, hex(data)] }),
    }
}

#[test]
fn bytes_mean_what_the_vectors_say() {
    for vector in vectors("messages") {
        let value = wire::decode(&bytes(&vector)).unwrap_or_else(|| panic!("{} cannot be read", vector["name"]));
        assert_eq!(meaning(&value), vector["meaning"], "{}", vector["name"]);
    }
}

#[test]
fn messages_are_read_and_written_as_the_vectors_say() {
    let mut seen = 0;
    for vector in vectors("messages") {
        let (data, name) = (bytes(&vector), &vector["name"]);
        let again = match vector["kind"].as_str().unwrap() {
            "Call" => wire::decode(&Call::read(&data).unwrap().bytes()),
            "Reply" => wire::decode(&Reply::read(&data).unwrap().bytes()),
            "Tally" => wire::decode(&wire::tally(wire::read_tally(&data).unwrap())),
            "Estop" => Some(Estop::read(&wire::decode(&data).unwrap()).unwrap().value()),
            "Token" => Some(Token::read(&wire::decode(&data).unwrap()).unwrap().value()),
            "EstopOrder" => {
                assert!(EstopOrder::read(&data, "anna").is_some(), "{name}");
                assert!(EstopOrder::read(&data, "bob").is_none_or(|order| order.opened.is_none()), "{name}");
                continue;
            }
            "Handle" => {
                assert!(Handle::read(&wire::decode(&data).unwrap()).is_some(), "{name}");
                continue;
            }
            _ => continue,
        };
        let again = meaning(&again.unwrap());
        let (ours, theirs) = (again.as_array().unwrap(), vector["meaning"].as_array().unwrap());
        let whole = theirs.last().unwrap().is_null() || theirs.len() < ours.len(); // nobody's behalf may be left out
        assert_eq!(ours[..8.min(theirs.len())], theirs[..8.min(theirs.len())], "{name}");
        assert!(whole || ours == theirs, "{name}");
        seen += 1;
    }
    assert!(seen > 8);
}

#[test]
fn an_estop_learnt_from_an_entry_says_who_told_of_it() {
    let given =
        Value::Array(vec!["5c0ffee5".into(), "anna/desk/4f2a".into(), "smoke".into(), 1.0.into(), "eve/x".into()]);
    let entry = wire::encode(&Value::Map(vec![("estops".into(), Value::Array(vec![given]))]));
    let told_by = |teller: &str| wire::told_estops(&entry, teller).unwrap().remove(0).told_by;
    assert_eq!(told_by("bob/page/77"), "bob/page");
    assert_eq!(told_by("anna/panel/88"), "");
}

#[test]
fn what_is_no_message_is_dropped() {
    for vector in vectors("dropped") {
        let (data, name) = (bytes(&vector), &vector["name"]);
        let read = match vector["kind"].as_str().unwrap() {
            "Call" => Call::read(&data).is_some(),
            "Reply" => Reply::read(&data).is_some(),
            "Tally" => wire::read_tally(&data).is_some(),
            "EstopOrder" => EstopOrder::read(&data, "anna").is_some(),
            _ => continue,
        };
        assert!(!read, "{name} was read");
    }
}
