"""Requests to a server on this machine, as a page or a stranger sends them."""

import http.client
import time
from urllib.parse import urlsplit


def asked(url, body=None, method=None, **headers):
    """Status, body and headers of an answer; names of headers with _ for -."""
    parts = urlsplit(url)
    connection = http.client.HTTPConnection(parts.hostname, parts.port, timeout=30)
    own = {"Host": parts.netloc, **{n.replace("_", "-"): v for n, v in headers.items()}}
    try:
        connection.request(method or ("GET" if body is None else "POST"), parts.path, body, own)
        answer = connection.getresponse()
        return answer.status, answer.read(), answer.headers
    finally:
        connection.close()


def origin_of(url):
    return f"http://{urlsplit(url).netloc}"


def wait_for(condition):
    deadline = time.monotonic() + 20.0
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.01)
