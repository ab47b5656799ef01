"""The locks: what is pinned, that nothing is missing, and that no address is in them."""

import re
import tomllib
from importlib import metadata
from pathlib import Path

import pytest
from packaging.markers import default_environment
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
EXTRAS = PROJECT["optional-dependencies"]
LOCKS = {
    "requirements.lock": PROJECT["dependencies"],
    "requirements-dev.lock": PROJECT["dependencies"] + EXTRAS["dev"] + EXTRAS["sd15"] + EXTRAS["fleet"],
}
"""What each lock is of."""
PYTHONS = ("3.11", "3.12", "3.13")
CUDA = ("nvidia-", "cuda-", "triton")
"""How what only CUDA builds of torch need begins."""
HASH = re.compile(r"--hash=sha256:[0-9a-f]{64}")


def entries(lock: str) -> list[tuple[Requirement, list[str]]]:
    """Each pinned release, with its options."""
    text = (ROOT / lock).read_text(encoding="utf-8").replace("\\\n", " ")
    lines = [line.split() for line in text.splitlines() if line and not line.startswith("#")]
    split = [next(i for i, word in enumerate([*words, "--"]) if word.startswith("--")) for words in lines]
    return [(Requirement(" ".join(words[:i])), words[i:]) for words, i in zip(lines, split, strict=True)]


def pins(lock: str, python: str) -> dict[str, str]:
    """The version of each package on 64-bit Linux."""
    target = {
        **default_environment(), "python_version": python, "python_full_version": f"{python}.0",
        "sys_platform": "linux", "platform_system": "Linux", "platform_machine": "x86_64", "os_name": "posix",
    }  # fmt: skip
    here = [entry for entry, _ in entries(lock) if entry.marker is None or entry.marker.evaluate(target)]
    assert len({canonicalize_name(entry.name) for entry in here}) == len(here), "a package is pinned twice"
    return {canonicalize_name(entry.name): str(entry.specifier).removeprefix("==") for entry in here}


@pytest.mark.parametrize("python", PYTHONS)
@pytest.mark.parametrize("lock", LOCKS)
def test_every_direct_dependency_is_pinned_within_its_range(lock: str, python: str) -> None:
    pinned = pins(lock, python)
    for wanted in map(Requirement, LOCKS[lock]):
        version = pinned[canonicalize_name(wanted.name)]
        assert wanted.specifier.contains(version), f"{wanted}: {version} is locked; run `make lock`"


@pytest.mark.parametrize("lock", LOCKS)
def test_each_release_has_hashes_and_nothing_has_an_address(lock: str) -> None:
    for entry, options in entries(lock):
        assert options, f"{entry} has no hash"
        assert all(HASH.fullmatch(option) for option in options), f"{entry}: {options}"
        assert re.fullmatch(r"==[^*]+", str(entry.specifier)), f"{entry} is not one release"
    assert not re.search(r"://|index|find-links|\bfile:|@", (ROOT / lock).read_text(encoding="utf-8"))


@pytest.mark.parametrize("lock", LOCKS)
def test_what_a_locked_package_needs_is_locked(lock: str) -> None:
    """Installing with hashes fails where anything is not; told by the packages that are installed here."""
    pinned = pins(lock, default_environment()["python_version"])
    seen = 0
    for name, version in pinned.items():
        try:
            package = metadata.distribution(name)
        except metadata.PackageNotFoundError:
            continue
        if package.version.partition("+")[0] != version:
            continue
        seen += 1
        for need in map(Requirement, package.requires or []):
            if need.marker is None or need.marker.evaluate({"extra": ""}):
                other = canonicalize_name(need.name)
                assert other in pinned or other.startswith(CUDA), f"{name} needs {need}, not in {lock}"
    assert seen > 5, "too few of the locked releases are installed to tell"


@pytest.mark.parametrize("lock", LOCKS)
def test_torch_is_the_one_that_is_installed_first_and_brings_no_cuda(lock: str) -> None:
    (first,) = re.findall(r"^TORCH \?= (\S+)$", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE)
    (image,) = re.findall(
        r"^ARG TORCH=(\S+)$", (ROOT / "Dockerfile").read_text(encoding="utf-8"), re.MULTILINE
    )
    pinned = pins(lock, PYTHONS[0])
    assert f"torch=={pinned['torch']}" == first == image
    assert not [name for name in pinned if name.startswith(CUDA)]


@pytest.mark.parametrize("python", PYTHONS)
def test_tests_run_with_what_users_get(python: str) -> None:
    assert pins("requirements.lock", python).items() <= pins("requirements-dev.lock", python).items()
