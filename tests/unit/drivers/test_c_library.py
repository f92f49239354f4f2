"""A compiled C library as services (examples/c_gripper): what goes in, what comes back, and what it refuses to be."""

import shutil
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from typing import Any

import pytest

from tests.support.c_compiler import library
from tests.support.waiting import wait_until
from trade import Handle, service, where
from trade.errors import ConfigurationError, InvalidArgument, LockedByOther, TradeError
from trade.testing import MemorySystem, memory_system
from trade_drivers.clibrary import CFunctionFailed, CLibrary

EXAMPLE = Path(__file__).parents[3] / "examples" / "c_gripper"
MORE = r"""
#include <stdint.h>
#include <stdbool.h>
#include <stdatomic.h>
#include <stddef.h>
#include <time.h>
typedef struct { double x, y; } pair_t;
typedef enum { RED, GREEN } colour_t;
double length(pair_t p) { return p.x + p.y; }
int sum(const int16_t *of, size_t n) { int s = 0; for (size_t i = 0; i < n; i++) s += of[i]; return s; }
uint8_t next(uint8_t n) { return n + 1; }
bool both(bool a, bool b) { return a && b; }
const char *greet(const char *name) { return name; }
const char *nothing(void) { return NULL; }
int minmax(const double *of, size_t n, double *least, double *most) {
    if (!n) return -7;
    *least = *most = of[0];
    for (size_t i = 1; i < n; i++) { if (of[i] < *least) *least = of[i]; if (of[i] > *most) *most = of[i]; }
    return 0;
}
void fill(double *into) { for (int i = 0; i < 3; i++) into[i] = i; }
colour_t other(colour_t c) { return c == RED ? GREEN : RED; }
int fails_above(int status) { return status; }
void crash(void) { *(volatile int *)0 = 0; }
bool works(bool well) { return well; }
float half(float of) { return of / 2; }
int with_mode(const double *of, int mode, size_t n) { return (int)n + mode + (of != NULL); }
colour_t paint(void) { return GREEN; }
static void rest(long ms) { struct timespec s = {0, ms * 1000000}; nanosleep(&s, NULL); }
static atomic_int halted;
int go(void) { rest(200); halted = 0; for (int i = 0; i < 20000 && !halted; i++) rest(1); return halted ? -2 : 0; }
int halt(void) { halted = 1; return 0; }
"""
MORE_HEADER = """
typedef struct { double x, y; } pair_t;
typedef enum { RED, GREEN } colour_t;
double length(pair_t p);
int sum(const int16_t *of, size_t n);
uint8_t next(uint8_t n);
bool both(bool a, bool b);
const char *greet(const char *name);
const char *nothing(void);
int minmax(const double *of, size_t n, double *least, double *most);
void fill(double *into);
colour_t other(colour_t c);
int fails_above(int status);
int missing(void);
void crash(void);
bool works(bool well);
float half(float of);
int with_mode(const double *of, int mode, size_t n);
colour_t paint(void);
int go(void);
int halt(void);
"""


@pytest.fixture(scope="module")
def example(tmp_path_factory: pytest.TempPathFactory) -> Any:
    """The module of the example, beside its compiled library."""
    folder = tmp_path_factory.mktemp("c_gripper")
    library(EXAMPLE / "gripper.c", folder / "libgripper.so")
    spec = spec_from_file_location("c_gripper_example", shutil.copy(EXAMPLE / "gripper.py", folder))
    assert spec is not None
    assert spec.loader is not None
    module = sys.modules["c_gripper_example"] = module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def lib(tmp_path_factory: pytest.TempPathFactory) -> CLibrary:
    folder = tmp_path_factory.mktemp("more")
    (folder / "more.c").write_text(MORE)
    return CLibrary(library(folder / "more.c", folder / "libmore.so"), MORE_HEADER)


class Hand:
    """The example's gripper in a container, and a program elsewhere that calls it."""

    def __init__(self, example: Any, system: MemorySystem, port: Path) -> None:
        self.system = system
        self.port = port
        self.gripper = example.CGripper(str(port))
        system.container("driver").register(self.gripper, "rosie.hand")
        self.caller = system.container("caller")

    def __call__(self, name: str) -> Handle:
        return self.caller.find(where(name=name, group="rosie.hand"), wait_s=20)

    @property
    def widths_m(self) -> list[float]:
        """The commands of the device."""
        return [float(line) for line in self.port.read_text().split()]


@pytest.fixture
def hand(example: Any, tmp_path: Path) -> Iterator[Hand]:
    with memory_system() as system:
        made = Hand(example, system, tmp_path / "port")
        yield made
    made.gripper.close()


@pytest.mark.slow
def test_functions_of_a_c_library_are_services_with_the_methods_signature(hand: Hand) -> None:
    move = hand("move_to")
    assert move.signature == "move_to(width_m: float (0 to 0.085), speed_m_s: float (<= 0.15, > 0) = 0.05) -> None"
    assert move.doc.startswith("Open or close")
    move(0.084, speed_m_s=0.15)
    state = hand("state")()
    assert (state.width_m, state.moving) == (0.084, False)
    assert hand("version")() == 4_000_000_000


def test_arrays_go_in_and_come_back(hand: Hand) -> None:
    hand("set_fingers")([0.1, -0.2])
    assert hand("forces_n")() == [1.0, -2.0]


def test_limits_of_the_method_hold_before_c_is_called(hand: Hand) -> None:
    with pytest.raises(InvalidArgument):
        hand("move_to")(0.2)
    assert hand.widths_m == []


def test_a_status_that_means_failure_is_an_error_with_the_librarys_own_text(hand: Hand) -> None:
    with pytest.raises(TradeError) as failed:
        hand("set_fingers")([0.1, 0.2, 0.3])
    assert isinstance(failed.value, CFunctionFailed)
    assert (failed.value.status, failed.value.text) == (-4, "it has two fingers")
    assert str(failed.value) == "gripper_set_fingers of libgripper.so failed with status -4: it has two fingers"


def test_S07_a_stop_ends_a_c_function_that_is_under_way(hand: Hand) -> None:
    run = hand("move_to").start(0.0, speed_m_s=0.01)
    wait_until(lambda: len(hand.widths_m) > 3)
    hand("stop")()
    with pytest.raises(TradeError):
        run.result(20)
    assert hand.widths_m[-1] > 0.05


def test_S03_what_its_caller_moves_stops_when_the_caller_is_gone(hand: Hand) -> None:
    hand("move_to").start(0.0, speed_m_s=0.01)
    wait_until(lambda: len(hand.widths_m) > 3)
    hand.system.kill("caller")
    wait_until(lambda: not hand.gripper.state().moving)
    assert hand.widths_m[-1] > 0.05


def test_S11_only_the_owner_of_the_lock_moves_the_hand(hand: Hand) -> None:
    other = hand.system.container("other")
    with other.lock(where(group="rosie.hand")):
        with pytest.raises(LockedByOther):
            hand("move_to")(0.01)
        assert hand.widths_m == []
        other.find(where(name="move_to", group="rosie.hand"))(0.0845)
    assert hand.widths_m[-1] == 0.0845


@dataclass
class OnlyX:
    x: float


class More:
    """What `MORE` offers, by the simplest of methods."""


def method(lib: CLibrary, name: str, declared: Any, **how: Any) -> Any:
    return lib.function(name, **how)(declared).__get__(More())


def test_numbers_texts_structs_and_arrays(lib: CLibrary, example: Any) -> None:
    @dataclass
    class Pair:
        x: float
        y: float

    globals()["Pair"] = Pair

    def length(self: object, p: Pair) -> float: ...
    def sum_of(self: object, of: list[int]) -> int: ...
    def next_(self: object, n: int) -> int: ...
    def both(self: object, a: bool, b: bool) -> bool: ...
    def greet(self: object, name: str) -> str: ...
    def nothing(self: object) -> str: ...
    def minmax(self: object, of: list[float]) -> tuple[float, float]: ...
    def fill(self: object) -> list[float]: ...
    def other(self: object, c: int) -> int: ...

    assert method(lib, "length", length)(Pair(1.5, 2.0)) == 3.5
    assert method(lib, "sum", sum_of)([1, -2, 3]) == 2
    assert method(lib, "sum", sum_of)(of=[]) == 0
    assert method(lib, "next", next_)(255) == 0
    assert method(lib, "both", both)(True, True) is True
    assert method(lib, "greet", greet)("grüße") == "grüße"
    assert method(lib, "nothing", nothing)() == ""
    assert method(lib, "minmax", minmax)([3.0, -1.0, 2.0]) == (-1.0, 3.0)
    assert method(lib, "fill", fill, out=3)() == [0.0, 1.0, 2.0]
    assert method(lib, "other", other)(0) == 1
    with pytest.raises(CFunctionFailed, match="status -7"):
        method(lib, "minmax", minmax)([])


@pytest.mark.parametrize("value", [256, -1, 1.5, "x"])
def test_a_value_that_c_cannot_hold_is_refused_and_never_truncated(lib: CLibrary, value: Any) -> None:
    def next_(self: object, n: int) -> int: ...

    with pytest.raises(InvalidArgument):
        method(lib, "next", next_)(value)


def test_a_text_with_a_zero_byte_is_refused(lib: CLibrary) -> None:
    def greet(self: object, name: str) -> str: ...

    with pytest.raises(InvalidArgument, match="zero byte"):
        method(lib, "greet", greet)("a\0b")


def test_which_status_means_failure_can_be_said(lib: CLibrary) -> None:
    positive = CLibrary(lib.path, MORE_HEADER, failed=lambda status: status > 0)

    def check(self: object, status: int) -> None: ...

    method(positive, "fails_above", check)(-1)
    with pytest.raises(CFunctionFailed, match="status 3"):
        method(positive, "fails_above", check)(3)
    method(lib, "fails_above", check, status=False)(-3)


def test_false_is_a_failure(lib: CLibrary) -> None:
    def works(self: object, well: bool) -> None: ...

    method(lib, "works", works)(True)
    with pytest.raises(CFunctionFailed):
        method(lib, "works", works)(False)


def test_a_number_that_a_float_of_c_cannot_hold_is_refused(lib: CLibrary) -> None:
    def half(self: object, of: float) -> float: ...

    assert method(lib, "half", half)(3.0) == 1.5
    with pytest.raises(InvalidArgument, match="more than a float"):
        method(lib, "half", half)(1e300)


class Slow:
    """Begins late, and then forgets all earlier commands."""

    def __init__(self, lib: CLibrary) -> None:
        def go(self: object) -> None: ...
        def halt(self: object) -> None: ...

        kind = type(self)
        kind.go = service(uses="it", cancel="halt")(lib.function("go")(go))  # type: ignore[attr-defined]
        kind.halt = service(effect="stop", uses="it")(lib.function("halt")(halt))  # type: ignore[attr-defined]


def test_S08_a_stop_that_comes_while_a_function_begins_stops_it_all_the_same(lib: CLibrary) -> None:
    with memory_system() as system:
        system.container("driver").register(Slow(lib), "slow")
        me = system.container("me")
        run = me.find(where(name="go", group="slow"), wait_s=20).with_(deadline_s=60).start()
        wait_until(lambda: lib._moving)
        me.find(where(name="halt", group="slow"), wait_s=20)()
        with pytest.raises(TradeError):
            run.result(10)


def unfit_cases() -> list[Any]:  # noqa: C901 - one small method for each
    def too_many(self: object, n: int, m: int) -> int: ...
    def too_few(self: object) -> int: ...
    def wrong_type(self: object, n: str) -> int: ...
    def no_type(self: object, n) -> int: ...  # type: ignore[no-untyped-def]
    def wrong_result(self: object, n: int) -> str: ...
    def no_list(self: object, of: list[float]) -> float: ...
    def array(self: object) -> list[float]: ...
    def void(self: object) -> int: ...
    def mode(self: object, of: list[float]) -> int: ...
    def part(self: object, p: OnlyX) -> float: ...
    def paint(self: object) -> None: ...

    return [
        pytest.param("next", too_many, "no parameter for m", id="too many"),
        pytest.param("next", too_few, "nothing is given", id="too few"),
        pytest.param("next", wrong_type, "n is str, the function takes uint8_t", id="type"),
        pytest.param("next", no_type, "does not say the type of n", id="untyped"),
        pytest.param("next", wrong_result, "cannot be str", id="result"),
        pytest.param("minmax", no_list, "nothing is given for its parameter double \\*", id="one of two results"),
        pytest.param("fill", array, "out=", id="array without a length"),
        pytest.param("crash", void, "cannot be int", id="nothing returned"),
        pytest.param("with_mode", mode, "nothing is given for its parameter size_t", id="a count too many"),
        pytest.param("length", part, "OnlyX has no y", id="a member is missing"),
        pytest.param("paint", paint, "say by failed=", id="a status that is never below zero"),
        pytest.param("missing", void, "no such function", id="not in the library"),
        pytest.param("undeclared", void, "no such function", id="not in the header"),
    ]


@pytest.mark.parametrize(("name", "declared", "problem"), unfit_cases())
def test_a_method_that_does_not_fit_is_refused_when_it_is_declared(
    lib: CLibrary, name: str, declared: Any, problem: str
) -> None:
    with pytest.raises(ConfigurationError, match=problem):
        lib.function(name)(declared)


def test_a_library_that_cannot_be_opened_or_read_says_so(lib: CLibrary, tmp_path: Path) -> None:
    with pytest.raises(ConfigurationError, match="cannot be opened"):
        CLibrary(tmp_path / "libnothing.so", "int f(void);")
    with pytest.raises(ConfigurationError, match="cannot be read"):
        CLibrary(lib.path, "#include <stdio.h>\nint f(")
