"""Every relative link, picture and page that anything names is there."""

import re

import pytest
from doc_pages import DOCS, PAGES, RECORDS, ROOT, anchors, name_of, prose

NAMING = [
    path
    for folder, kinds in {
        "src": ("py", "md"), "conf": ("yaml",), "tests": ("py",), "scripts": ("py",),
    }.items()
    for kind in kinds
    for path in sorted((ROOT / folder).rglob(f"*.{kind}"))
    if ".egg-info" not in path.as_posix()
]  # fmt: skip


@pytest.mark.parametrize("path", PAGES, ids=name_of)
def test_links_of_pages(path):
    for target in re.findall(r"\]\(([^)\s]+)\)", prose(path)):
        if re.match(r"[a-z]+:", target):
            continue
        file, _, anchor = target.partition("#")
        found = (path.parent / file).resolve() if file else path
        assert found.exists(), f"{name_of(path)} links to {target}, which is not there"
        if anchor:
            assert anchor in anchors(found), f"{name_of(path)} links to {target}: no such heading"


def test_pages_that_code_and_settings_name():
    named = []
    for path in NAMING:
        for page in re.findall(r"docs/[\w./-]+\.(?:md|png)", path.read_text(encoding="utf-8")):
            named.append(page)
            assert (ROOT / page).exists(), f"{name_of(path)} names {page}, which is not there"
    assert len(named) > 20


def test_every_page_is_linked_from_another():
    linked = set()
    for path in PAGES:
        for target in re.findall(r"\]\(([^)#\s]+)", prose(path)):
            if not re.match(r"[a-z]+:", target):
                linked.add((path.parent / target).resolve())
    lonely = [name_of(path) for path in DOCS.rglob("*.md") if path.resolve() not in linked]
    assert lonely == []


def test_experiments_are_numbered_and_dated():
    for number, path in enumerate(RECORDS, 1):
        heading = path.read_text(encoding="utf-8").split("\n", 1)[0]
        assert path.name.startswith(f"{number:03d}-"), path.name
        assert re.fullmatch(rf"# {number:03d} .+ \(20\d\d-\d\d-\d\d( to 20\d\d-\d\d-\d\d)?\)", heading), (
            path.name
        )
