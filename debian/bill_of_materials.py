"""The package's bill of materials (SBOM), CycloneDX 1.6 as JSON: ``python -m debian.bill_of_materials LIB REPORT WHEEL FILE``.

It says what lies in the package's environment: each Python package with its version, its licence and the digest of the file
that it was installed from; and where a package has a bill of its own, of the libraries in its wheel. LIB is the environment's
folder of packages, REPORT what ``pip install --report`` wrote when it filled it, WHEEL the file of failover itself. The same
packages make the same bytes.

Source: cyclonedx.org/docs/1.6/json; the package URL specification, type pypi.
"""

from __future__ import annotations

import hashlib
import json
import re
import sys
import uuid
from importlib.metadata import Distribution, distributions
from pathlib import Path
from typing import Any

VERSION = "1.6"
LICENCE_NAME_MAX = 80
"""Characters: a longer field holds a licence's text, and not its name."""


def bill(lib: Path, report: dict[str, Any], wheel: Path) -> dict[str, Any]:
    """The bill.

    Raises:
        SystemExit: a package is there that the report does not know in that version: says which.
    """
    digests = {_normal(one["metadata"]["name"]): _digest(one) for one in report["install"]}
    digests["failover"] = hashlib.sha256(wheel.read_bytes()).hexdigest()
    reported = {(_normal(one["metadata"]["name"]), one["metadata"]["version"]) for one in report["install"]}
    there = {_normal(one.name): one for one in distributions(path=[str(lib)])}
    stray = sorted({(name, one.version) for name, one in there.items() if name != "failover"} ^ reported)
    if stray or "failover" not in there:
        sys.exit(f"bill of materials: {lib} does not hold what was installed: {stray or 'failover is missing'}")
    parts = [_component(one, digests[name]) for name, one in sorted(there.items())]
    said: dict[str, Any] = {
        "$schema": f"http://cyclonedx.org/schema/bom-{VERSION}.schema.json",
        "bomFormat": "CycloneDX",
        "specVersion": VERSION,
        "version": 1,
        "metadata": {"component": next(one | {"type": "application"} for one in parts if one["name"] == "failover")},
        "components": [one for one in parts if one["name"] != "failover"],
        "dependencies": [_needs(one, there) for _, one in sorted(there.items())],
    }
    number = uuid.uuid5(uuid.NAMESPACE_URL, json.dumps(said, sort_keys=True))
    return said | {"serialNumber": f"urn:uuid:{number}"}


def _component(one: Distribution, digest: str) -> dict[str, Any]:
    said: dict[str, Any] = {
        "type": "library",
        "bom-ref": _reference(one),
        "name": _normal(one.name),
        "version": one.version,
        "purl": _reference(one),
        "hashes": [{"alg": "SHA-256", "content": digest}],
    }
    licences = _licences(one)
    own = sorted(path.as_posix() for path in one.files or () if path.parent.name == "sboms" and path.suffix == ".json")
    references = [{"type": "bom", "url": path} for path in own]
    return said | ({"licenses": licences} if licences else {}) | ({"externalReferences": references} if references else {})


def _reference(one: Distribution) -> str:
    return f"pkg:pypi/{_normal(one.name)}@{one.version}"


def _licences(one: Distribution) -> list[dict[str, Any]]:
    """As the project says: an expression of SPDX; else a name; else the names in its classifiers."""
    metadata = one.metadata
    if expression := metadata.get("License-Expression"):
        return [{"expression": expression}]
    name = (metadata.get("License") or "").strip()
    if name and "\n" not in name and len(name) <= LICENCE_NAME_MAX:
        return [{"license": {"name": name}}]
    classifiers = [line.rpartition(" :: ")[2] for line in metadata.get_all("Classifier") or () if line.startswith("License :: ")]
    return [{"license": {"name": line}} for line in classifiers]


def _needs(one: Distribution, there: dict[str, Distribution]) -> dict[str, Any]:
    """Which of the others a package names as needed, for whatever extra or machine: what is not there is left out."""
    names = {_normal(match[0]) for line in one.requires or () if (match := re.match(r"[A-Za-z0-9][A-Za-z0-9._-]*", line))}
    return {
        "ref": _reference(one),
        "dependsOn": [_reference(there[name]) for name in sorted(names & there.keys() - {_normal(one.name)})],
    }


def _digest(installed: dict[str, Any]) -> str:
    archive = installed["download_info"]["archive_info"]
    hashes = archive.get("hashes") or dict([archive["hash"].split("=", 1)])  # pip 22 has the older field
    return str(hashes["sha256"])


def _normal(name: str) -> str:
    """Source: the packaging specifications, name normalization."""
    return re.sub(r"[-_.]+", "-", name).lower()


def main(lib: Path, report: Path, wheel: Path, file: Path) -> None:
    """Write it."""
    said = bill(lib, json.loads(report.read_text()), wheel)
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(json.dumps(said, indent=1, sort_keys=True, ensure_ascii=False) + "\n")


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:]))
