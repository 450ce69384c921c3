"""Stores on this machine that write down what they were asked for and how much they sent."""

from __future__ import annotations

import contextlib
import os
import ssl
import threading
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib import import_module
from pathlib import Path
from typing import Any

SECRET = "kept-to-oneself"


@dataclass
class Ledger:
    """Requests that were answered: method, path and bytes of the answer's body."""

    entries: list[tuple[str, str, int]] = field(default_factory=list)

    def clear(self) -> None:
        self.entries.clear()

    def sent(self, method: str = "GET") -> int:
        return sum(size for verb, _, size in self.entries if verb == method)

    def count(self, method: str = "GET") -> int:
        return sum(verb == method for verb, _, _ in self.entries)


class S3:
    """A server that talks as S3 does."""

    def __init__(self, address: str, ledger: Ledger) -> None:
        self.address = address
        self.ledger = ledger
        self.failing: Callable[[str, str], bool] = lambda method, path: False

    def client(self) -> Any:
        boto3: Any = import_module("boto3")
        return boto3.client("s3", endpoint_url=self.address)

    def put(self, bucket: str, key: str, data: bytes) -> str:
        self.client().put_object(Bucket=bucket, Key=key, Body=data)
        return f"s3://{bucket}/{key}"

    def get(self, bucket: str, key: str) -> bytes:
        body: bytes = self.client().get_object(Bucket=bucket, Key=key)["Body"].read()
        return body

    def keys(self, bucket: str) -> list[str]:
        found = self.client().list_objects_v2(Bucket=bucket).get("Contents", [])
        return [entry["Key"] for entry in found]


@contextlib.contextmanager
def s3_server() -> Iterator[S3]:
    """The server on loopback; the environment leads to it."""
    from moto.moto_server.werkzeug_app import (  # noqa: PLC0415 (slow)
        DomainDispatcherApplication,
        create_backend_app,
    )
    from werkzeug.serving import make_server  # noqa: PLC0415

    inner = DomainDispatcherApplication(create_backend_app)
    ledger = Ledger()

    def application(environ: dict[str, Any], start_response: Any) -> Iterable[bytes]:
        method, path = environ["REQUEST_METHOD"], environ["PATH_INFO"]
        if server_of.failing(method, path):
            start_response("503 Service Unavailable", [("Content-Length", "0")])
            return [b""]
        body = b"".join(inner(environ, start_response))
        ledger.entries.append((method, path, len(body)))
        return [body]

    server = make_server("127.0.0.1", 0, application, threaded=True)
    server_of = S3(f"http://127.0.0.1:{server.server_port}", ledger)
    changed = {
        "AWS_ENDPOINT_URL": server_of.address,
        "AWS_ACCESS_KEY_ID": "someone",
        "AWS_SECRET_ACCESS_KEY": SECRET,
        "AWS_DEFAULT_REGION": "us-east-1",
        "AWS_EC2_METADATA_DISABLED": "true",
        "NO_PROXY": "127.0.0.1,localhost",
    }
    before = {name: os.environ.get(name) for name in changed}
    os.environ.update(changed)
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    try:
        yield server_of
    finally:
        server.shutdown()
        server.server_close()
        thread.join()
        for name, value in before.items():
            os.environ.pop(name) if value is None else os.environ.update({name: value})


@dataclass
class Web:
    """A web server over some files.

    Attributes:
        address: To which ``/name`` is added.
        ledger: What was asked for.
        files: What it has, by name.
        ranges: Whether it sends parts.
        failures: How many more requests end in the middle of the answer.
        heads: Whether it answers HEAD, which signed addresses often forbid.
    """

    address: str = ""
    ledger: Ledger = field(default_factory=Ledger)
    files: dict[str, bytes] = field(default_factory=dict)
    ranges: bool = True
    failures: int = 0
    tagged: bool = True


@contextlib.contextmanager
def web_server(certificate: Path | None = None) -> Iterator[Web]:
    """The server on loopback, over TLS if there is a certificate (with its key)."""
    web = Web()

    class Handler(BaseHTTPRequestHandler):
        protocol_version = "HTTP/1.1"

        def do_GET(self) -> None:
            path, _, query = self.path.partition("?")
            if path == "/private.mcap" and query != f"signature={SECRET}":
                self.refuse(403)
            elif (data := web.files.get(path[1:])) is None:
                self.refuse(404)
            else:
                self.answer(path, data)

        def answer(self, path: str, data: bytes) -> None:
            span = self.headers.get("Range") if web.ranges else None
            self.send_response(200 if span is None else 206)
            if span is not None:
                first, last = span.removeprefix("bytes=").split("-")
                start, stop = int(first), min(int(last) + 1, len(data))
                self.send_header("Content-Range", f"bytes {start}-{stop - 1}/{len(data)}")
                data = data[start:stop]
            if web.tagged:
                self.send_header("ETag", '"one"')
            self.send_header("Content-Length", str(len(data)))
            self.end_headers()
            if web.failures and len(data) > 1:
                web.failures -= 1
                self.wfile.write(data[: len(data) // 2])
                self.close_connection = True
                return
            web.ledger.entries.append(("GET", path, len(data)))
            with contextlib.suppress(OSError):  # one byte was enough
                self.wfile.write(data)

        def do_HEAD(self) -> None:
            self.refuse(403)

        def refuse(self, status: int) -> None:
            self.send_response(status)
            self.send_header("Content-Length", "0")
            self.end_headers()

        def log_message(self, *_: Any) -> None:
            pass

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    server.daemon_threads = True
    scheme = "http"
    if certificate is not None:
        context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
        context.load_cert_chain(certificate)
        server.socket = context.wrap_socket(server.socket, server_side=True)
        scheme = "https"
    web.address = f"{scheme}://localhost:{server.server_port}"
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    try:
        yield web
    finally:
        server.shutdown()
        server.server_close()
        thread.join()
