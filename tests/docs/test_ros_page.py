"""docs/ros.md names each test that runs against a real ROS 2, and no other."""

import re

from tests.docs.blocks import DOCS, ROOT


def test_the_page_names_the_tests_with_a_real_ros_2() -> None:
    named = re.findall(r"`(test_\w+)`", (DOCS / "ros.md").read_text(encoding="utf-8"))
    source = (ROOT / "tests" / "system" / "test_real_ros2.py").read_text(encoding="utf-8")
    assert sorted(named) == sorted(re.findall(r"^def (test_\w+)", source, re.MULTILINE))
