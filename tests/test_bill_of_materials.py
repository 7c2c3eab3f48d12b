"""The package's bill of materials: true to what is installed, in the published form; and what the audit of versions says."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import sysconfig
import threading
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib.metadata import distributions
from pathlib import Path
from typing import Any

import pytest

from debian import bill_of_materials
from tests.audit import ROOT, TOOL

SITE = Path(sysconfig.get_path("purelib"))
has_tools = pytest.mark.skipif(not TOOL.exists(), reason="./run test installs pip-audit and the schema into .venv/audit")


def report(site: Path = SITE) -> dict[str, Any]:
    """As pip writes it for what lies there, with digests by name."""
    others = [one for one in distributions(path=[str(site)]) if one.name != "failover"]
    return {
        "install": [
            {
                "metadata": {"name": one.name, "version": one.version},
                "download_info": {"archive_info": {"hash": f"sha256={one.name.encode().hex():0>64.64}"}},
            }
            for one in others
        ]
    }


@pytest.fixture
def bill(tmp_path: Path) -> dict[str, Any]:
    """Of the environment that runs this test."""
    wheel = tmp_path / "failover.whl"
    wheel.write_bytes(b"a wheel")
    return bill_of_materials.bill(SITE, report(), wheel)


def test_each_package_is_in_it_with_version_digest_licence_and_what_it_needs(bill: dict[str, Any]) -> None:
    there = {one["name"]: one for one in bill["components"]}
    assert len(there) == len(report()["install"])
    expected = {"pyzmq": [{"expression": "BSD-3-Clause"}], "rich": [{"license": {"name": "MIT"}}]}
    assert {name: there[name]["licenses"] for name in expected} == expected
    assert there["python-ptrace"]["licenses"] == [{"license": {"name": "GNU GPL v2"}}]
    assert all(len(one["hashes"][0]["content"]) == 64 for one in there.values())
    ours = bill["metadata"]["component"]
    assert ours["name"] == "failover" and ours["type"] == "application"
    needs = {one["ref"]: one["dependsOn"] for one in bill["dependencies"]}
    assert there["msgspec"]["purl"] in needs[ours["bom-ref"]]


def test_the_same_packages_make_the_same_bytes_and_others_are_refused(tmp_path: Path) -> None:
    wheel = tmp_path / "failover.whl"
    wheel.write_bytes(b"a wheel")
    (tmp_path / "report").write_text(json.dumps(report()))
    files = [tmp_path / "deep/one.json", tmp_path / "two.json"]
    for file in files:
        bill_of_materials.main(SITE, tmp_path / "report", wheel, file)
    assert files[0].read_bytes() == files[1].read_bytes()
    less = report()
    gone = less["install"].pop()["metadata"]["name"].lower()
    with pytest.raises(SystemExit, match=f"does not hold what was installed: .*{gone}"):
        bill_of_materials.bill(SITE, less, wheel)


CHECK = """
import sys
from cyclonedx.schema import SchemaVersion
from cyclonedx.validation.json import JsonStrictValidator
error = JsonStrictValidator(SchemaVersion.V1_6).validate_str(sys.stdin.read())
sys.exit(str(error) if error else 0)
"""


@has_tools
def test_it_has_the_published_form(bill: dict[str, Any]) -> None:
    def checked(said: dict[str, Any]) -> int:
        python = TOOL.parent / "python"
        return subprocess.run([python, "-c", CHECK], input=json.dumps(said), text=True, capture_output=True).returncode

    assert checked(bill) == 0
    assert checked(bill | {"bomFormat": "another"}) == 1


# --- The audit, with a database of this test's own ------------------------------------------------------------------------------


class Osv(BaseHTTPRequestHandler):
    """Answers as OSV does: one version of msgspec is bad. Source: google.github.io/osv.dev, POST /v1/query."""

    def do_POST(self) -> None:
        asked = json.loads(self.rfile.read(int(self.headers["content-length"])))
        package = asked["package"]
        bad = {"id": "OSV-1", "aliases": ["CVE-1"], "summary": "x", "details": "x", "modified": "2026-01-01T00:00:00Z"}
        ranges = [{"type": "ECOSYSTEM", "events": [{"introduced": "0"}, {"fixed": "99.1"}]}]
        vulns = [bad | {"affected": [{"package": package, "ranges": ranges}]}] if package["name"] in self.server.bad else []  # type: ignore[attr-defined]
        content = json.dumps({"vulns": vulns} if vulns else {}).encode()
        self.send_response(200)
        self.send_header("content-type", "application/json")
        self.send_header("content-length", str(len(content)))
        self.end_headers()
        self.wfile.write(content)

    def log_message(self, *_: object) -> None:
        """Nothing."""


@pytest.fixture
def osv() -> Iterator[Any]:
    """A database at a port of this machine; what is in its ``bad`` has a vulnerability."""
    with ThreadingHTTPServer(("127.0.0.1", 0), Osv) as server:
        server.bad = set()  # type: ignore[attr-defined]
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        yield server
        server.shutdown()
        thread.join()


def audit(url: str) -> subprocess.CompletedProcess[str]:
    environment = os.environ | {"FAILOVER_OSV_URL": url, "NO_PROXY": "127.0.0.1"}
    return subprocess.run([sys.executable, "-m", "tests.audit"], cwd=ROOT, env=environment, capture_output=True, text=True)


@has_tools
def test_an_audit_names_what_is_known_and_says_when_nothing_can_be_known(osv: Any) -> None:
    url = f"http://127.0.0.1:{osv.server_port}/v1/query"
    well = audit(url)
    assert well.returncode == 0 and "audit: no vulnerability is known in " in well.stdout, well.stderr
    osv.bad.add("msgspec")
    ill = audit(url)
    assert ill.returncode == 1
    assert "OSV-1" in ill.stdout and "CVE-1" in ill.stdout and "mended in 99.1" in ill.stdout
    none = audit("http://127.0.0.1:9/v1/query")
    assert none.returncode == 2 and "cannot be asked, so nothing is known" in none.stderr and "Traceback" not in none.stderr
