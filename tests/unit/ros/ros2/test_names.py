"""Keys and tokens: by the examples of rmw_zenoh's design document, and by packages of other hands."""

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pamoja import ros2 as pamoja
from zenoh_ros2_sdk.entity import EndpointEntity, EntityKind, NodeEntity
from zenoh_ros2_sdk.keyexpr import endpoint_liveliness_keyexpr, node_liveliness_keyexpr
from zenoh_ros2_sdk.qos import QosDurability, QosHistoryKind, QosProfile, QosReliability

from trade.errors import ConfigurationError
from trade_gateway.ros.ros2._names import (
    TokenContent,
    TokenKind,
    absolute,
    data_key,
    dds_type,
    gid,
    node_token,
    read_token,
    token,
)
from trade_gateway.ros.ros2._node import LATCHED, USUAL

STRING = "std_msgs/msg/String"
STRING_HASH = "RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18"
ADD = "example_interfaces/srv/AddTwoInts"
ADD_HASH = "RIHS01_e118de6bf5eeb66a2491b5bda11202e7b68f198d6f67922cf30364858239c81a"

RAFT = (
    "@ros2_lv/23/aac3178e146ba6f1fc6e6a4085e77f21/0/{}/%/%raft_test/raft_fixture/%raft_test%chatter/"
    f"std_msgs::msg::dds_::String_/{STRING_HASH}/2::,5:,:,:,,"
)

parts = st.from_regex(r"[A-Za-z][A-Za-z0-9]{0,8}(_[A-Za-z0-9]{1,4})?", fullmatch=True)
names = st.lists(parts, min_size=1, max_size=4).map(lambda each: "/" + "/".join(each))
packages = st.from_regex(r"[a-z][a-z0-9]{0,8}(_[a-z0-9]{1,8}){0,2}", fullmatch=True)
types = st.builds(
    "{}/{}/{}".format,
    packages,
    st.sampled_from(["msg", "srv", "action"]),
    st.from_regex(r"[A-Z][A-Za-z0-9]{0,12}", fullmatch=True),
)
hashes = st.binary(min_size=32, max_size=32).map(lambda digest: f"RIHS01_{digest.hex()}")
sessions = st.integers(1, 2**128 - 1).map("{:x}".format)


@pytest.mark.parametrize(
    ("domain_id", "name", "type_name", "type_hash", "key"),
    [
        (0, "/chatter", STRING, STRING_HASH, f"0/chatter/std_msgs::msg::dds_::String_/{STRING_HASH}"),
        (0, "/robot1/chatter", STRING, STRING_HASH, f"0/robot1/chatter/std_msgs::msg::dds_::String_/{STRING_HASH}"),
        (2, "/add_two_ints", ADD, ADD_HASH, f"2/add_two_ints/example_interfaces::srv::dds_::AddTwoInts_/{ADD_HASH}"),
    ],
)
def test_keys_are_those_of_the_design_document(
    domain_id: int, name: str, type_name: str, type_hash: str, key: str
) -> None:
    assert data_key(domain_id, name, type_name, type_hash) == key


TOKENS = {
    "@ros2_lv/2/aac3178e146ba6f1fc6e6a4085e77f21/0/0/NN/%/%/listener": TokenContent(
        "aac3178e146ba6f1fc6e6a4085e77f21", TokenKind.NODE, "/listener"
    ),
    "@ros2_lv/2/aac3178e146ba6f1fc6e6a4085e77f21/0/10/MS/%/%/listener/%chatter/std_msgs::msg::dds_::String_/"
    f"{STRING_HASH}/::,10:,:,:,,": TokenContent(
        "aac3178e146ba6f1fc6e6a4085e77f21", TokenKind.SUBSCRIPTION, "/listener", "/chatter"
    ),
    "@ros2_lv/2/f9980ee0495eaafb3e38f0d19e2eae12/0/10/SS/%/%/add_two_ints_server/%add_two_ints/"
    f"example_interfaces::srv::dds_::AddTwoInts_/{ADD_HASH}/::,10:,:,:,,": TokenContent(
        "f9980ee0495eaafb3e38f0d19e2eae12", TokenKind.SERVER, "/add_two_ints_server", "/add_two_ints"
    ),
}


@pytest.mark.parametrize(("written", "seen"), TOKENS.items(), ids=[seen.kind.value for seen in TOKENS.values()])
def test_tokens_of_the_design_document_are_read(written: str, seen: TokenContent) -> None:
    assert read_token(written) == seen


def test_tokens_are_written_as_in_the_design_document() -> None:
    node, subscription, server = TOKENS
    listener = "aac3178e146ba6f1fc6e6a4085e77f21"
    assert node_token(2, listener, "/listener") == node
    assert (
        token(2, listener, 10, TokenKind.SUBSCRIPTION, "/listener", "/chatter", STRING, STRING_HASH, USUAL)
        == subscription
    )
    adder, name = "f9980ee0495eaafb3e38f0d19e2eae12", "/add_two_ints_server"
    assert token(2, adder, 10, TokenKind.SERVER, name, "/add_two_ints", ADD, ADD_HASH, USUAL) == server


@pytest.mark.parametrize(
    ("of", "expected"),
    [
        (
            f"@ros2_lv/0/1/0/0/MP/%/%/a/%b/a::msg::dds_::B_/{STRING_HASH}/::,:,:,:,,",
            "d6944d1f878b2ccca940730c04a67353",
        ),
        (
            RAFT.format("1/MP"),
            "e4f56c26790a63265397a613657e3aab",
        ),
        (
            RAFT.format("2/MS"),
            "3747c389aa1c3b32ca6f32a904ff7c18",
        ),
    ],
)
def test_gids_are_those_that_rmw_zenoh_makes(of: str, expected: str) -> None:
    """Captured from its own function by the test suite of a client for microcontrollers (RaftROS)."""
    assert gid(of).hex() == expected


@given(st.integers(0, 232), names, types, hashes)
def test_keys_are_those_of_another_package(domain_id: int, name: str, type_name: str, type_hash: str) -> None:
    assert data_key(domain_id, name, type_name, type_hash) == pamoja.entity_key(domain_id, name, type_name, type_hash)
    assert dds_type(type_name) == pamoja.dds_type_name(type_name)


@given(st.text("aZ_1/~*%-ä ", max_size=12))
def test_names_are_taken_that_another_package_takes(name: str) -> None:
    try:
        taken = absolute(name) == name
    except ConfigurationError:
        taken = False
    assert taken == (pamoja.is_valid_name(name) and pamoja.is_fully_qualified(name))


@given(
    st.integers(0, 232),
    sessions,
    st.integers(1, 10**6),
    st.sampled_from(list(TokenKind)[1:]),
    names,
    names,
    types,
    hashes,
)
def test_tokens_are_those_of_another_package(
    domain_id: int, session: str, number: int, kind: TokenKind, node: str, name: str, type_name: str, type_hash: str
) -> None:
    namespace, _, base = node.rpartition("/")
    theirs = NodeEntity(domain_id, session, 0, base, namespace or "/")
    assert node_token(domain_id, session, node) == node_liveliness_keyexpr(theirs)
    endpoint = EndpointEntity(theirs, number, EntityKind(kind.value), name, dds_type(type_name), type_hash, USUAL)
    ours = token(domain_id, session, number, kind, node, name, type_name, type_hash, USUAL)
    assert ours == endpoint_liveliness_keyexpr(endpoint)
    assert read_token(ours) == TokenContent(session, kind, node, name)


def test_qualities_of_service_are_read_by_another_package() -> None:
    usual, latched = QosProfile.decode(USUAL), QosProfile.decode(LATCHED)
    assert usual == QosProfile(QosReliability.RELIABLE, QosDurability.VOLATILE, QosHistoryKind.KEEP_LAST, 10)
    assert latched == QosProfile(QosReliability.RELIABLE, QosDurability.TRANSIENT_LOCAL, QosHistoryKind.KEEP_LAST, 1)


@pytest.mark.parametrize(("written", "seen"), TOKENS.items(), ids=[seen.kind.value for seen in TOKENS.values()])
def test_what_a_later_version_adds_to_a_token_is_left_alone(written: str, seen: TokenContent) -> None:
    assert read_token(f"{written}/more") == seen


@given(st.text("@ros2_lv/0NMP%:,.a", max_size=60))
def test_what_is_no_token_is_left_alone(key: str) -> None:
    assert read_token(key) is None


@pytest.mark.parametrize(
    "key",
    [
        "@ros2_lv/0/1/0/0/XX/%/%/a",
        "@ros2_lv/0/1/0/0/MP/%/%/a",
        "@ros1_lv/0/1/0/0/NN/%/%/a",
    ],
)
def test_a_token_of_another_kind_is_left_alone(key: str) -> None:
    assert read_token(key) is None


@pytest.mark.parametrize("type_name", ["String", "std_msgs/String", "std_msgs/msg/", "a/idl/B", "A/msg/B", "a/msg/B/C"])
def test_what_is_no_type_is_refused(type_name: str) -> None:
    with pytest.raises(ConfigurationError, match="must be written package/msg/Name"):
        dds_type(type_name)
