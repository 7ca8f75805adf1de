"""Messages between two processes."""

from __future__ import annotations

import multiprocessing
import os
import pickle
import struct

import numpy as np
import pytest

from stereo_sfm.pipeline.channels import Arrivals, Inbox, Lost, Outbox, PrefetchingInbox


def test_half_a_message_makes_nobody_wait() -> None:
    """A long message whose sender is computing: it is there when its last byte is."""
    receive, send = multiprocessing.Pipe(duplex=False)
    update = np.arange(1000.0)
    data = pickle.dumps(update)
    data = struct.pack("!i", len(data)) + data  # as `Connection.send` writes it
    inbox = PrefetchingInbox[np.ndarray](receive)
    os.write(send.fileno(), data[:2000])
    assert not inbox.ready()
    os.write(send.fileno(), data[2000:])
    assert (inbox.take() == update).all()
    assert not inbox.ready()


@pytest.mark.parametrize("kind", [Inbox, PrefetchingInbox])
def test_messages_come_before_the_loss_of_their_sender(kind: type[Inbox[int] | PrefetchingInbox[int]]) -> None:
    receive, send = multiprocessing.Pipe(duplex=False)
    inbox = kind(receive)
    send.send(1)
    send.send(2)
    send.close()
    assert [inbox.take(), inbox.take()] == [1, 2]
    for _ in range(2):
        with pytest.raises(Lost):
            inbox.take()


def test_a_pickled_message_is_passed_on_as_it_is() -> None:
    receive, send = multiprocessing.Pipe(duplex=False)
    outbox, inbox = Outbox(send), Inbox[dict[str, int]](receive)
    outbox.send({"a": 1})
    outbox.send(pickle.dumps({"b": 2}))
    assert [inbox.take(), inbox.take()] == [{"a": 1}, {"b": 2}]
    outbox.close()


def test_messages_that_the_pipe_has_no_room_for_come_in_order() -> None:
    receive, send = multiprocessing.Pipe(duplex=False)
    outbox, inbox = Outbox(send, 100), Inbox[np.ndarray](receive)
    sent = [np.full(size, k) for k, size in enumerate((10, 200_000, 10, 50_000, 1, 300_000, 2))]
    for message in sent:
        outbox.send(message)
    assert outbox.waiting() > 0
    for message in sent:
        assert (inbox.take() == message).all()
    outbox.send(np.zeros(1))
    assert len(inbox.take()) == 1
    outbox.close()
    with pytest.raises(Lost):
        inbox.take()


def test_an_outbox_takes_no_more_than_its_limit() -> None:
    receive, send = multiprocessing.Pipe(duplex=False)
    outbox, inbox = Outbox(send, 2), Inbox[bytes](receive)
    message = pickle.dumps(bytes(1 << 20))
    taken = 0
    while outbox.offer(message, 0.1):
        taken += 1
    assert 2 <= taken <= 4
    for _ in range(taken):
        inbox.take()
    assert outbox.offer(message, 10.0)
    assert len(inbox.take()) == 1 << 20
    receive.close()
    outbox.send(1)  # nobody reads: it is dropped
    outbox.close()


def test_arrivals_follow_the_connections_that_are_left() -> None:
    (a, to_a), (b, to_b) = multiprocessing.Pipe(duplex=False), multiprocessing.Pipe(duplex=False)
    arrivals = Arrivals()
    assert arrivals.wait([a, b], 0.0) == []
    to_b.send(1)
    assert arrivals.wait([a, b], 10.0) == [b]
    b.close()
    to_a.close()
    assert arrivals.wait([a], 10.0) == [a]  # its end is an arrival too
    to_b.close()
