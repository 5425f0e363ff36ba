# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""
The web server of the live view: a page and its data, read-only.

The page requests nothing from other servers, as its content security policy states. A check of the
Host header prevents DNS rebinding, by which a foreign site could read the data.
"""

from collections.abc import Callable
from contextlib import suppress
from errno import EADDRINUSE
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib.resources import files
import ipaddress
import json
import socket
from socketserver import TCPServer
import sys
from threading import Thread
import time
from typing import Any
from urllib.parse import parse_qs, urlsplit

from sa_jitter_ros.errors import ParameterError

PORTS_TRIED = 20  # from `port` on, so that a second view on the same host starts, too
CONNECTIONS = 32  # at once; a further one takes the place of the slowest request
REQUEST_SECONDS = 10.0  # for all of a request to arrive
ANSWER_SECONDS = 60.0  # for the answer to leave, which a slow line carries
KINDS = {'html': 'text/html', 'css': 'text/css', 'js': 'text/javascript'}
HEADERS = {
    'Cache-Control': 'no-store',
    'Content-Security-Policy': "default-src 'self'; frame-ancestors 'none'; "
                               "img-src 'self' blob: data:",  # charts become pictures
    'Cross-Origin-Resource-Policy': 'same-origin',
    'Referrer-Policy': 'no-referrer',
    'X-Content-Type-Options': 'nosniff',
}


def is_loopback(host: str) -> bool:
    """Return whether only this machine can reach an address to listen on."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == 'localhost'


def is_name_of_this_machine(header: str) -> bool:
    """
    Return whether a Host header names this machine, with any port (a tunnel changes it).

    Every address is accepted, because it cannot be rebound, but only names that no foreign name
    server can resolve.
    """
    try:
        host = urlsplit(f'//{header}').hostname or ''
    except ValueError:
        return False
    try:
        ipaddress.ip_address(host)
    except ValueError:
        machine = socket.gethostname().lower()
        return host in ('localhost', machine, f'{machine}.local')
    return True


class PageServer(ThreadingHTTPServer):
    """
    Serves the page and the JSON object `snapshot(since, channel)` from a separate thread.

    It listens on `host` and the first free `port` from the one given on (0: any). Raises
    `ParameterError` where this is not possible. `requests` counts answered requests, `refused`
    those that were no GET, had a foreign host name, or were too many at once.
    """

    daemon_threads = True

    def __init__(self, snapshot: Callable[[int, int], dict[str, Any]], *, host: str, port: int
                 ) -> None:
        folder = files('sa_jitter_ros.nodes').joinpath('live_view_page')
        self.pages = {f'/{item.name}': item.read_bytes() for item in folder.iterdir()
                      if item.name.rpartition('.')[2] in KINDS}
        self.pages['/'] = self.pages['/index.html']
        self.snapshot = snapshot
        self.requests = self.refused = 0
        self._deadlines: dict[socket.socket, float] = {}
        self._asking: dict[socket.socket, None] = {}  # those whose request has not arrived yet
        self.address_family = socket.AF_INET6 if ':' in host else socket.AF_INET
        super().__init__((host, port), _Handler, bind_and_activate=False)
        try:
            self._listen(host, port)
        except ParameterError:
            self.server_close()
            raise
        self.port = int(self.server_address[1])
        name = socket.gethostname() if host in ('0.0.0.0', '::') else host
        self.address = f'http://{f"[{name}]" if ":" in name else name}:{self.port}/'
        self._thread = Thread(target=self.serve_forever, kwargs={'poll_interval': 0.05},
                              name='live_view', daemon=True)
        self._thread.start()

    def _listen(self, host: str, port: int) -> None:
        last = min(port + PORTS_TRIED, 65536) if port else 1
        for candidate in range(port, last):
            self.socket.close()  # one that was bound, but cannot listen, cannot be bound again
            self.socket = socket.socket(self.address_family, self.socket_type)
            self.server_address = (host, candidate)
            try:
                self.server_bind()
                self.server_activate()
            except OSError as error:
                if error.errno != EADDRINUSE:
                    raise ParameterError(f'cannot listen on {host} port {candidate}: '
                                         f'{error.strerror or error}') from None
            else:
                return
        raise ParameterError(f'ports {port} to {last - 1} of {host} are in use: set another port, '
                             'or 0 for any free port')

    def close(self) -> None:
        """Stop the server."""
        self.shutdown()
        self.server_close()
        self._thread.join()

    def server_bind(self) -> None:
        """Bind without a query to a name server."""
        TCPServer.server_bind(self)

    def process_request(self, request: Any, client_address: Any) -> None:
        """Serve in a thread, in place of the slowest request if there are too many."""
        if len(self._deadlines) >= CONNECTIONS:
            slowest = next(iter(list(self._asking)), None)  # the one that asks for longest
            if slowest is None:
                self.refused += 1
                self.shutdown_request(request)
                return
            self._end(slowest)
        self._deadlines[request] = time.monotonic() + REQUEST_SECONDS
        self._asking[request] = None
        super().process_request(request, client_address)

    def process_request_thread(self, request: Any, client_address: Any) -> None:
        """Serve one connection."""
        try:
            super().process_request_thread(request, client_address)
        finally:
            self._deadlines.pop(request, None)
            self._asking.pop(request, None)

    def _end(self, connection: socket.socket) -> None:
        self.refused += 1
        self._deadlines.pop(connection, None)
        self._asking.pop(connection, None)
        with suppress(OSError):  # it may have ended
            connection.shutdown(socket.SHUT_RDWR)

    def asked(self, connection: socket.socket) -> None:
        """Take note that a request has arrived; its answer may last as long again."""
        self._deadlines[connection] = time.monotonic() + ANSWER_SECONDS
        self._asking.pop(connection, None)

    def service_actions(self) -> None:
        """End connections that last too long, however slowly their bytes drip."""
        now = time.monotonic()
        for connection, deadline in list(self._deadlines.items()):
            if now > deadline:
                self._end(connection)

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Ignore that a browser closed the connection."""
        if not isinstance(sys.exc_info()[1], OSError):
            super().handle_error(request, client_address)


class _Handler(BaseHTTPRequestHandler):
    server: PageServer
    timeout = ANSWER_SECONDS
    server_version, sys_version = 'live_view', ''

    def do_GET(self) -> None:
        """Answer with a file of the page or with the snapshot."""
        self.server.asked(self.connection)
        path, _, query = self.path.partition('?')
        if not is_name_of_this_machine(self.headers.get('Host', '')):
            self._refuse(HTTPStatus.FORBIDDEN, 'open this page by its address or as localhost')
        elif path == '/snapshot.json':
            given = parse_qs(query)
            numbers = [given.get(name, ['0'])[0] for name in ('since', 'channel')]
            if not all(item.isascii() and item.isdecimal() and len(item) < 20 for item in numbers):
                self._refuse(HTTPStatus.BAD_REQUEST, 'since must be the version of a snapshot, '
                             'channel the number of a channel')
                return
            content = json.dumps(self.server.snapshot(*map(int, numbers)), allow_nan=False)
            self._send(HTTPStatus.OK, 'application/json', content.encode())
        elif path in self.server.pages:
            kind = KINDS['html' if path == '/' else path.rpartition('.')[2]]
            self._send(HTTPStatus.OK, f'{kind}; charset=utf-8', self.server.pages[path])
        else:
            self._refuse(HTTPStatus.NOT_FOUND, 'no such page')

    def _only_get(self) -> None:
        self._refuse(HTTPStatus.METHOD_NOT_ALLOWED, 'read-only: use GET', Allow='GET')

    do_CONNECT = do_DELETE = do_HEAD = do_OPTIONS = do_PATCH = do_POST = do_PUT = do_TRACE = \
        _only_get

    def _refuse(self, status: HTTPStatus, text: str, **headers: str) -> None:
        self.server.refused += 1
        self._send(status, 'text/plain; charset=utf-8', f'{text}\n'.encode(), **headers)

    def _send(self, status: HTTPStatus, kind: str, body: bytes, **headers: str) -> None:
        self.server.requests += 1
        self.send_response(status)
        sent = {'Content-Type': kind, 'Content-Length': str(len(body)), **HEADERS, **headers}
        for name, value in sent.items():
            self.send_header(name, value)
        self.end_headers()
        if self.command != 'HEAD':
            self.wfile.write(body)

    def log_message(self, *arguments: Any) -> None:
        """Write no line for each request: the terminal is for messages of nodes."""
