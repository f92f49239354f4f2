"""Type hashes, by those that ROS 2 itself has made.

Sources: ros2/rmw_zenoh ``docs/design.md`` (String, AddTwoInts); files that ``rosidl`` of Jazzy generated for
``arduinobot_messages/action/Fibonacci`` (``fibonacci__description.c`` in adamfalkowski/ROS2_Arduionobot, which gives
all its parts, and Time, UUID and ServiceEventInfo); tests of other implementations that took theirs from
``/opt/ros/jazzy/share/**/*.json`` (``rcl_interfaces``, ``action_msgs``, the other Fibonaccis).
"""

from pathlib import Path

import pytest
from zenoh_ros2_sdk.utils import compute_service_type_hash, compute_type_hash_from_msg

from tests.support.ros2_processes import DEFINITIONS
from trade.errors import ConfigurationError
from trade_gateway.ros.ros2._hashes import Hashes
from trade_gateway.ros_messages._types import Types

MESSAGES = {
    "std_msgs/msg/String": "df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18",
    "builtin_interfaces/msg/Time": "b106235e25a4c5ed35098aa0a61a3ee9c9b18d197f398b0e4206cea9acf9c197",
    "unique_identifier_msgs/msg/UUID": "1b8e8aca958cbea28fe6ef60bf6c19b683c97a9ef60bb34752067d0f2f7ab437",
    "service_msgs/msg/ServiceEventInfo": "41bcbbe07a75c9b52bc96bfd5c24d7f0fc0a08c0cb7921b3373c5732345a6f45",
    "action_msgs/msg/GoalStatusArray": "6c1684b00f177d37438febe6e709fc4e2b0d4248dca4854946f9ed8b30cda83e",
    "rcl_interfaces/msg/Log": "e28ce254ca8abc06abf92773b74602cdbf116ed34fbaf294fb9f81da9f318eac",
    "rcl_interfaces/msg/ParameterEvent": "043e627780fcad87a22d225bc2a037361dba713fca6a6b9f4b869a5aa0393204",
}
SERVICES = {
    "example_interfaces/srv/AddTwoInts": "e118de6bf5eeb66a2491b5bda11202e7b68f198d6f67922cf30364858239c81a",
    "action_msgs/srv/CancelGoal": "573d8b0a534451d7bc2ac8c5ffde8ac14b8593b7001175d0cd6516dcbeb8689a",
    "rcl_interfaces/srv/DescribeParameters": "845b484d71eb0673dae682f2e3ba3c4851a65a3dcfb97bddd82c5b57e91e4cff",
    "rcl_interfaces/srv/GetParameters": "bf9803d5c74cf989a5de3e0c2e99444599a627c7ff75f97b8c05b01003675cbc",
    "rcl_interfaces/srv/GetParameterTypes": "da199c878688b3e530bdfe3ca8f74cb9fa0c303101e980a9e8f260e25e1c80ca",
    "rcl_interfaces/srv/ListParameters": "3e6062bfbb27bfb8730d4cef2558221f51a11646d78e7bb30a1e83afac3aad9d",
    "rcl_interfaces/srv/SetParameters": "56eed9a67e169f9cb6c1f987bc88f868c14a8fc9f743a263bc734c154015d7e0",
    "rcl_interfaces/srv/SetParametersAtomically": "0e192ef259c07fc3c07a13191d27002222e65e00ccec653ca05e856f79285fcd",
}
ARDUINOBOT = "arduinobot_messages/action/Fibonacci"
ARDUINOBOT_MESSAGES = {
    "Goal": "c3e55c5a1481b85553f6a244574e2278ee928d803fd8f916bc79a6e85eb4d914",
    "Result": "aed57b6a429cfd588686005db8a6ea767e45309801d7954cf78e395770de1e38",
    "Feedback": "d1fe760d30714a7b671152917a9553e45cad40c0b0bb501071016797e583748a",
    "SendGoal_Request": "c700d0b504329ef534b82bcba16f068e4fde6279df72880ddae2cbcb4a128cc4",
    "SendGoal_Response": "8cea35f7b9442d4c494f5dcd4c2963d0d1d36da877edf757add15cd7f9036235",
    "GetResult_Request": "42ac0ea440a24bd065473603682db8c02d6829c5a442216379bec1a486ab684f",
    "GetResult_Response": "fe54a471dd64dc8f5eb29a91165e5581dece6d53133e0e5eade3d31a920390e7",
    "FeedbackMessage": "c9dcd87763d2024be3a4aa1ea8627816a2d2cfba5493fb4494082d332aa619dd",
}
ACTIONS = {
    (ARDUINOBOT, "SendGoal"): "2d5305b009286b59775b3158cc9f248321ff32c350ce20c06489539fde1cfca4",
    (ARDUINOBOT, "GetResult"): "adf5237c256993411f5d087bc8141393d6a112f5c710eb7ef61df23d0f129966",
    (
        "example_interfaces/action/Fibonacci",
        "SendGoal",
    ): "d1a57fb2a4afe8c21e34fb10db206f16ce6729b28531141472df92277c55b557",
    (
        "example_interfaces/action/Fibonacci",
        "GetResult",
    ): "1b0de0d5d29dc955d92f546706568428632771db13ec84c15ec1c1a59f424a57",
}


@pytest.fixture(scope="module")
def types(tmp_path_factory: pytest.TempPathFactory) -> Types:
    folder = tmp_path_factory.mktemp("types")
    write(folder, f"{ARDUINOBOT}.action", "int32 order\n---\nint32[] sequence\n---\nint32[] partial_sequence\n")
    write(folder, "odd_ones/msg/Chars.msg", "char one\nchar[4] four\n")
    return Types(2, [folder, DEFINITIONS])


@pytest.fixture(scope="module")
def hashes(types: Types) -> Hashes:
    return Hashes(types)


def write(folder: Path, name: str, text: str) -> None:
    (folder / name).parent.mkdir(parents=True, exist_ok=True)
    (folder / name).write_text(text)


@pytest.mark.parametrize(("type_name", "digest"), MESSAGES.items())
def test_messages_have_the_hashes_of_ros(hashes: Hashes, type_name: str, digest: str) -> None:
    assert hashes.message(type_name) == f"RIHS01_{digest}"


@pytest.mark.parametrize(("type_name", "digest"), SERVICES.items())
def test_services_have_the_hashes_of_ros(hashes: Hashes, type_name: str, digest: str) -> None:
    assert hashes.service(type_name) == f"RIHS01_{digest}"


@pytest.mark.parametrize(("part", "digest"), ARDUINOBOT_MESSAGES.items())
def test_messages_of_actions_have_the_hashes_of_ros(hashes: Hashes, part: str, digest: str) -> None:
    hashes.learn_action(ARDUINOBOT)
    assert hashes.message(f"{ARDUINOBOT}_{part}") == f"RIHS01_{digest}"


@pytest.mark.parametrize(("part", "digest"), ACTIONS.items(), ids=" ".join)
def test_services_of_actions_have_the_hashes_of_ros(hashes: Hashes, part: tuple[str, str], digest: str) -> None:
    type_name, service = part
    hashes.learn_action(type_name)
    assert hashes.service(f"{type_name}_{service}") == f"RIHS01_{digest}"


def test_a_char_is_a_number_of_8_bits(hashes: Hashes) -> None:
    numbers = compute_type_hash_from_msg("odd_ones/msg/Chars", "uint8 one\nuint8[4] four\n")
    assert hashes.message("odd_ones/msg/Chars") == numbers


@pytest.mark.parametrize(
    ("type_name", "asked", "answered"),
    [
        ("std_srvs/srv/SetBool", "bool data\n", "bool success\nstring message\n"),
        ("rcl_interfaces/srv/GetParameterTypes", "string[] names\n", "uint8[] types\n"),
    ],
)
def test_services_have_the_hashes_that_another_package_gives_them(
    hashes: Hashes, type_name: str, asked: str, answered: str
) -> None:
    assert hashes.service(type_name) == compute_service_type_hash(type_name, asked, answered)


def test_a_type_that_is_not_known_is_refused(hashes: Hashes) -> None:
    with pytest.raises(ConfigurationError, match="Put its definition in a folder of types"):
        hashes.message("missing/msg/Unknown")
