"""A web server on loopback, with or without ranges of bytes, that counts what it sends."""

import re
import threading
from contextlib import contextmanager
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer


@dataclass
class WebServer:
    """Files by path; what was asked of it and sent, bytes counted at the socket, heads included."""

    files: dict[str, bytes] = field(default_factory=dict)
    ranges: bool = True
    refuse: bool = False
    etag: str = '"first"'
    address: str = ""
    asked: list[tuple[str, str | None]] = field(default_factory=list)
    sent: int = 0
    lock: threading.Lock = field(default_factory=threading.Lock)

    def url(self, name):
        return f"{self.address}/{name}"


def _handler(server):
    class Handler(BaseHTTPRequestHandler):
        protocol_version = "HTTP/1.1"

        def log_message(self, *_):
            pass

        def setup(self):
            super().setup()
            write = self.wfile.write

            def counted(data):
                with server.lock:
                    server.sent += len(data)
                return write(data)

            self.wfile.write = counted

        def answer(self, code, body=b"", **heads):
            self.send_response(code)
            for name, value in heads.items():
                self.send_header(name.replace("_", "-"), value)
            self.send_header("Content-Length", str(len(body)))
            self.end_headers()
            self.wfile.write(body)

        def do_GET(self):
            byte_range = self.headers.get("Range")
            with server.lock:
                server.asked.append((self.path, byte_range))
            data = server.files.get(self.path.partition("?")[0].lstrip("/"))
            if server.refuse:
                self.answer(403)
            elif data is None:
                self.answer(404)
            elif byte_range is None or not server.ranges:
                self.answer(200, data, ETag=server.etag)
            else:
                first, last = map(int, re.fullmatch(r"bytes=(\d+)-(\d+)", byte_range).groups())
                if first >= len(data):
                    self.answer(416)
                    return
                body = data[first : last + 1]
                place = f"bytes {first}-{first + len(body) - 1}/{len(data)}"
                self.answer(206, body, ETag=server.etag, Content_Range=place)

    return Handler


@contextmanager
def web_server(**options):
    """Serve files until the end of the block."""
    server = WebServer(**options)
    with ThreadingHTTPServer(("127.0.0.1", 0), _handler(server)) as running:
        server.address = f"http://127.0.0.1:{running.server_port}"
        thread = threading.Thread(target=running.serve_forever, daemon=True)
        thread.start()
        yield server
        running.shutdown()
        thread.join()
