"""Conformance of transports: announcements, queries and signs of life."""

# ruff: noqa: S101 - these are tests

import contextlib
from abc import ABC, abstractmethod
from collections.abc import Callable, Generator
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager

from trade.testing._ear import PATIENCE_S, RecordingListener, RegistryResponder, meet
from trade.transport.base import ChannelClosed, Message, Transport


class StandingConformance(ABC):
    """The part of `TransportConformance` about announcements, queries and signs of life."""

    @abstractmethod
    def network(self) -> AbstractContextManager[Callable[[], Transport]]:
        """An empty network; it is closed with all its transports at the end.

        Returns:
            A context manager that yields a function. Each call of it opens one more transport and returns when that is
            linked with those opened before.
        """

    @contextlib.contextmanager
    def pair(self) -> Generator[tuple[Transport, Transport], None, None]:
        """Two transports of one network."""
        with self.network() as open_transport:
            yield open_transport(), open_transport()

    # --- announcements

    def test_announcements_are_heard_in_order_whatever_their_keys(self) -> None:
        with self.pair() as (one, other):
            ear = RecordingListener(other.announcements("shop/**"))
            meet(listener=other, speaker=one)
            sent = [Message(f"shop/{number % 7}/{number}", str(number).encode()) for number in range(2000)]
            for message in sent:
                one.announce(message.key, message.payload or b"")
            assert [ear.next() for _ in sent] == sent

    def test_who_listens_later_hears_nothing_of_what_was_announced(self) -> None:
        with self.pair() as (one, other):
            early = RecordingListener(other.announcements("shop/**"))
            meet(listener=other, speaker=one)
            one.announce("shop/bread", b"1")
            assert early.next().payload == b"1"
            late = RecordingListener(other.announcements("shop/**"))
            meet(listener=other, speaker=one)
            one.announce("shop/bread", b"2")
            assert late.next().payload == b"2"

    def test_no_member_hears_its_own_announcements(self) -> None:
        with self.pair() as (one, other):
            ear = RecordingListener(one.announcements("shop/**"))
            meet(listener=one, speaker=other)
            one.announce("shop/own", b"1")
            other.announce("shop/other", b"1")
            assert ear.next() == Message("shop/other", b"1")

    # --- queries

    def test_a_query_gets_all_current_entries_of_each_member_that_answers(self) -> None:
        with self.network() as open_transport:
            one, other = open_transport(), open_transport()
            RegistryResponder(one, "shop/one/*", {"shop/one/bread": b"fresh", "shop/one/milk": b"cold"})
            RegistryResponder(other, "shop/other/*", {"shop/other/eggs": b"12"})
            _signs = one.appear("alive/one"), other.appear("alive/other")
            late = open_transport()
            _wait_for(late, 2)
            answers = late.ask(["shop/**"], PATIENCE_S)
            assert sorted([(message.key, message.payload) for message in answer.messages] for answer in answers) == [
                [("shop/one/bread", b"fresh"), ("shop/one/milk", b"cold")],
                [("shop/other/eggs", b"12")],
            ]
            assert len({answer.who for answer in answers}) == 2

    def test_once_a_sign_of_life_has_risen_its_transport_can_be_asked(self) -> None:
        with self.pair() as (one, other):
            signs = RecordingListener(other.presences("alive/*"))
            for turn in range(50):
                RegistryResponder(one, f"shop-{turn}/*", {f"shop-{turn}/bread": b"fresh"})
                sign = one.appear(f"alive/{turn}")
                signs.until(f"alive/{turn}", b"")
                [answer] = other.ask([f"shop-{turn}/*"], PATIENCE_S)
                assert answer.messages == [Message(f"shop-{turn}/bread", b"fresh")]
                sign.close()

    def test_ten_thousand_entries_are_sent_in_order(self) -> None:
        with self.pair() as (one, other):
            standing = {f"shop/{number}": str(number).encode() * 100 for number in range(10_000)}
            RegistryResponder(one, "shop/*", standing)
            meet(listener=one, speaker=other)
            [answer] = other.ask(["shop/**"], 6 * PATIENCE_S)
            assert [(message.key, message.payload) for message in answer.messages] == list(standing.items())

    def test_only_the_requested_entries_are_sent_by_the_members_that_were_asked(self) -> None:
        with self.pair() as (one, other):
            RegistryResponder(one, "shop/*/one/*", {"shop/food/one/bread": b"fresh", "shop/tools/one/saw": b"sharp"})
            RegistryResponder(one, "bank/*", {"shop/food/one/poison": b"", "bank/money": b"1"})
            meet(listener=one, speaker=other)
            [answer] = other.ask(["shop/food/one/*"], PATIENCE_S)
            assert answer.messages == [Message("shop/food/one/bread", b"fresh")]

    def test_what_a_member_replies_to_several_queries_is_one_answer(self) -> None:
        with self.network() as open_transport:
            one, other, late = (open_transport() for _ in range(3))
            RegistryResponder(one, "shop/*", {"shop/bread": b"fresh", "shop/milk": b"cold", "shop/salt": b"1"})
            RegistryResponder(other, "bank/*", {"bank/money": b"1"})
            _signs = one.appear("alive/one"), other.appear("alive/other")
            _wait_for(late, 2)
            answers = late.ask(["shop/bread", "bank/*", "shop/milk"], PATIENCE_S)
            assert sorted([message.key for message in answer.messages] for answer in answers) == [
                ["bank/money"],
                ["shop/bread", "shop/milk"],
            ]

    def test_no_member_queries_itself(self) -> None:
        with self.pair() as (one, _):
            RegistryResponder(one, "shop/*", {"shop/bread": b"fresh"})
            assert one.ask(["shop/**"], PATIENCE_S) == []

    def test_a_question_that_is_not_ended_ends_at_its_deadline_with_what_was_said(self) -> None:
        with self.pair() as (one, other):
            questions = one.questions("shop/*")
            meet(listener=one, speaker=other)
            with ThreadPoolExecutor(1) as pool:
                asked = pool.submit(other.ask, ["shop/*"], 1.0)
                question = questions.receive()
                question.answer("shop/bread", b"fresh")
                [answer] = asked.result(PATIENCE_S)
                assert answer.messages == [Message("shop/bread", b"fresh")]
            question.close()

    def test_who_closes_amid_a_question_is_not_waited_for(self) -> None:
        with self.pair() as (one, other):
            questions = one.questions("shop/*")
            meet(listener=one, speaker=other)
            with ThreadPoolExecutor(1) as pool:
                asked = pool.submit(other.ask, ["shop/*"], 3600.0)
                question = questions.receive()
                one.close()
                assert asked.result(PATIENCE_S) == []
            question.close()

    def test_who_asks_and_closes_waits_no_longer(self) -> None:
        with self.pair() as (one, other):
            questions = one.questions("shop/*")
            meet(listener=one, speaker=other)
            with ThreadPoolExecutor(1) as pool:
                asked = pool.submit(other.ask, ["shop/*"], 3600.0)
                question = questions.receive()
                other.close()
                with contextlib.suppress(ChannelClosed):
                    assert asked.result(PATIENCE_S) == []
            question.close()

    def test_a_question_that_was_closed_takes_no_answer(self) -> None:
        with self.pair() as (one, other):
            questions, refused = one.questions("shop/*"), False
            meet(listener=one, speaker=other)
            with ThreadPoolExecutor(1) as pool:
                asked = pool.submit(other.ask, ["shop/*"], PATIENCE_S)
                question = questions.receive()
                question.close()
                question.close()
                try:
                    question.answer("shop/bread", b"stale")
                except ChannelClosed:
                    refused = True
                assert refused
                assert asked.result(PATIENCE_S) == []

    def test_who_is_closed_is_asked_nothing(self) -> None:
        with self.pair() as (one, other):
            teller = RegistryResponder(one, "shop/*", {"shop/bread": b"fresh"})
            meet(listener=one, speaker=other)
            assert len(other.ask(["shop/*"], PATIENCE_S)) == 1
            teller.questions.close()
            teller.questions.close()
            meet(listener=one, speaker=other)
            assert other.ask(["shop/*"], PATIENCE_S) == []

    # --- presence

    def test_a_sign_of_life_rises_falls_and_returns(self) -> None:
        with self.pair() as (one, other):
            ear = RecordingListener(other.presences("alive/**"))
            for _ in range(3):
                sign = one.appear("alive/one")
                assert ear.next() == Message("alive/one", b"")
                sign.close()
                assert ear.next() == Message("alive/one", None)

    def test_signs_of_life_fall_when_their_transport_closes(self) -> None:
        with self.pair() as (one, other):
            ear = RecordingListener(other.presences("alive/**"))
            _kept = one.appear("alive/a"), one.appear("alive/b")
            assert {ear.next().key for _ in range(2)} == {"alive/a", "alive/b"}
            one.close()
            falls = {(message.key, message.payload) for message in (ear.next(), ear.next())}
            assert falls == {("alive/a", None), ("alive/b", None)}

    def test_signs_of_life_that_stand_are_heard_first(self) -> None:
        with self.network() as open_transport:
            one = open_transport()
            _kept = one.appear("alive/a"), one.appear("alive/b")
            ear = RecordingListener(open_transport().presences("alive/**"))
            assert {ear.next() for _ in range(2)} == {Message("alive/a", b""), Message("alive/b", b"")}
            _more = one.appear("alive/c")
            assert ear.next() == Message("alive/c", b"")

    def test_signs_of_life_of_ones_own_are_heard_too(self) -> None:
        with self.pair() as (one, _):
            ear = RecordingListener(one.presences("alive/**"))
            sign = one.appear("alive/one")
            assert ear.next() == Message("alive/one", b"")
            assert one.present("alive/**", PATIENCE_S) == ["alive/one"]
            sign.close()
            assert ear.next() == Message("alive/one", None)

    def test_signs_of_life_that_stand_can_be_asked_for(self) -> None:
        with self.network() as open_transport:
            one, other = open_transport(), open_transport()
            _kept = one.appear("alive/one"), other.appear("alive/other"), one.appear("dead/one")
            one.appear("alive/gone").close()
            assert sorted(open_transport().present("alive/*", PATIENCE_S)) == ["alive/one", "alive/other"]


def _wait_for(transport: Transport, signs: int) -> None:
    ear = RecordingListener(transport.presences("alive/**"))
    for _ in range(signs):
        ear.next()
    ear.channel.close()
