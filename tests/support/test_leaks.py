"""The leak check itself: what it must catch, it catches."""

from pathlib import Path

import pytest

pytestmark = pytest.mark.realtime

pytest_plugins = ["pytester"]

LEAKS = {
    "thread": """
        import threading
        def test_leaks():
            threading.Thread(target=threading.Event().wait, args=(30,), daemon=True, name="left-behind").start()
    """,
    "file": """
        kept = []
        def test_leaks():
            kept.append(open(__file__))
    """,
    "process": """
        import subprocess, sys
        kept = []
        def test_leaks():
            kept.append(subprocess.Popen([sys.executable, "-c", "import time; time.sleep(30)"]))
    """,
    "task": """
        import asyncio
        loop = asyncio.new_event_loop()
        def test_leaks():
            async def begin():
                asyncio.get_running_loop().kept = asyncio.ensure_future(asyncio.sleep(30))
            loop.run_until_complete(begin())
    """,
}


@pytest.mark.parametrize("what", LEAKS)
def test_a_test_that_leaves_something_behind_fails(
    what: str, pytester: pytest.Pytester, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PYTHONPATH", str(Path(__file__).parents[2]))
    conftest = Path(__file__).parents[1].joinpath("conftest.py").read_text(encoding="utf-8")
    pytester.makeconftest(conftest.replace("_SETTLE_S = 15.0", "_SETTLE_S = 0.2"))
    pytester.makepyfile(LEAKS[what] + "\n\n        def test_innocent():\n            pass\n")
    result = pytester.runpytest_subprocess("-q")
    result.assert_outcomes(passed=2, errors=1)
    result.stdout.fnmatch_lines([f"*the test left behind: {what}*"])
