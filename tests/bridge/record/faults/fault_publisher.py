"""A publisher in its own process with its own account, doing what each line on stdin asks."""

import base64
import hashlib
import json
import os
import sys
import time
from typing import Any

import zenoh
from fault_messages import NUMBER, STAMP, streams

from bridge.wire.clocks import announce
from bridge.wire.config import WireConfig
from bridge.wire.qos import Qos
from bridge.wire.session import WireSession, open_session

OWN_QOS = {"joints": Qos.CONTROL, "gripper": Qos.CONTROL}


class Publisher:
    def __init__(self, session: WireSession, account: int) -> None:
        """Use one session for everything, so that all arrives in the order it left."""
        self.session = session
        self.plain: Any = session._inner  # for what our publishers would refuse to send
        self.account = account
        self.publishers: dict[str, Any] = {}
        self.counts: dict[str, int] = {}

    def book(self, topic: str, sequence: int | None, gid: str, data: bytes | bytearray) -> None:
        digest = hashlib.sha256(data).hexdigest()
        line = json.dumps([time.time_ns(), topic, sequence, gid, digest])
        os.write(self.account, line.encode() + b"\n")

    def puts(self, puts: list[dict[str, Any]]) -> None:
        for put in puts:
            data = bytes(put["zeros"]) if "zeros" in put else base64.b64decode(put["data"])
            self.book(put["topic"], put["sequence"], put["gid"], data)
            note = put["note"]
            self.plain.put(
                put["key"],
                data,
                encoding=put["encoding"] or None,
                attachment=None if note is None else base64.b64decode(note),
                congestion_control=zenoh.CongestionControl.BLOCK,
            )

    def ask(self, verb: str, payload: bytes) -> dict[str, Any]:
        for reply in self.plain.get(f"rec/main/ctl/{verb}", payload=payload, timeout=60.0):
            if reply.ok is not None:
                return {"ok": json.loads(reply.ok.payload.to_bytes())}
            return {"refused": reply.err.payload.to_bytes().decode(errors="replace")}
        return {"refused": "nobody answered"}

    def flow(self, seconds: float, names: list[str], qos: str, period_s: float) -> dict[str, int]:
        """Publish at the streams' rates, or as many ticks as fit when ``period_s`` is 0."""
        made = {name: streams()[name] for name in names}
        data = {name: bytearray(message) for name, (*_, message) in made.items()}
        for name, (topic, kind, *_) in made.items():
            if name not in self.publishers:
                own = OWN_QOS.get(name, Qos.CAMERA)
                chosen = own if qos == "own" else getattr(Qos, qos.upper())
                self.publishers[name] = self.session.publisher(topic, kind, qos=chosen)
                self.counts[name] = 0
        begin_s, tick = time.monotonic(), 0
        while tick == 0 or time.monotonic() < begin_s + seconds:
            for name, (topic, _, every, _) in made.items():
                if tick % every == 0:
                    self.send(name, topic, data[name])
            tick += 1
            time.sleep(max(0.0, min(period_s, begin_s + tick * period_s - time.monotonic())))
        return self.counts

    def send(self, name: str, topic: str, data: bytearray) -> None:
        publisher, number = self.publishers[name], self.counts[name]
        data[STAMP] = number.to_bytes(8, "little")
        if name in ("depth", "raw"):  # pixels: each piece the network cuts tells its message
            data[4096::8192] = bytes([number % 251]) * len(data[4096::8192])
        if name == "color":  # a camera that shows one picture is a fault
            at = data.index(NUMBER) + len(NUMBER)
            data[at : at + 8] = f"{number:08d}".encode()
        self.book(topic, number, publisher.gid.hex(), data)
        publisher.put(bytes(data), source_ns=time.time_ns())
        self.counts[name] = number + 1


def main() -> None:
    endpoint, account_path = sys.argv[1:3]
    account = os.open(account_path, os.O_WRONLY | os.O_CREAT | os.O_APPEND)
    with open_session(WireConfig(connect=(endpoint,))) as session:
        announce(session, "faults")
        publisher = Publisher(session, account)
        print(json.dumps("ready"), flush=True)
        for line in sys.stdin:
            request = json.loads(line)
            answer: Any = "done"
            if "puts" in request:
                publisher.puts(request["puts"])
            elif "ask" in request:
                answer = publisher.ask(request["ask"], base64.b64decode(request["payload"]))
            else:
                names, period_s = request["streams"], request["period_s"]
                answer = publisher.flow(request["flow"], names, request["qos"], period_s)
            print(json.dumps(answer), flush=True)


if __name__ == "__main__":
    main()
