"""What pages quote: defaults, commands, messages, sources, the version; and how long they are."""

import ast
import re
import shlex
from functools import cache

import pytest
import yaml
from doc_pages import DOCS, ROOT, TODAY, blocks, inline_code, name_of, prose
from hydra import compose, initialize_config_dir
from hydra.core.plugins import Plugins
from omegaconf import OmegaConf

import occfusion
from occfusion.__main__ import VERBS
from occfusion.settings.schema import load_settings

TOKEN = re.compile(r"[a-z_0-9]+(\.[a-z_0-9]+)*=\S+")
MOST_WORDS = 8000


@cache
def composed(*overrides: str):
    with initialize_config_dir(str(ROOT / "conf"), version_base="1.3"):
        return compose("config", list(overrides))


def quotes(path):
    """Inline code of the form `choice=x key.inner=value`: the choices, and the settings that follow from them."""
    for code in inline_code(path):
        tokens = code.split()
        if all(TOKEN.fullmatch(token) for token in tokens):
            yield (
                code,
                [t for t in tokens if "." not in t.split("=")[0]],
                [t for t in tokens if "." in t.split("=")[0]],
            )


def is_default(token: str, choices: list[str]) -> bool:
    key, _, quoted = token.partition("=")
    value = OmegaConf.select(composed(*choices), key, default="no such setting")
    try:
        return float(quoted) == float(value) and not isinstance(value, bool)
    except (TypeError, ValueError):
        return (
            yaml.safe_load(quoted) == OmegaConf.to_container(value)
            if OmegaConf.is_config(value)
            else (yaml.safe_load(quoted) == value)
        )


@pytest.mark.parametrize("path", TODAY, ids=name_of)
def test_quoted_settings_are_those_of_the_configuration(path):
    for code, choices, settings in quotes(path):
        for token in settings:
            assert is_default(token, choices), f"{name_of(path)} says `{code}`: {token} is not so"
        if not settings and "…" not in code and "..." not in code:
            load_settings(composed(*choices))  # a choice that exists


def test_defaults_are_quoted_where_they_are_explained():
    found = {path.name: sum(len(settings) for *_, settings in quotes(path)) for path in TODAY}
    assert found["optim.md"] > 15 and found["refine.md"] > 12 and found["init.md"] >= 4


def test_a_wrong_quote_is_found():
    assert is_default("optim.steps=1200", []) and not is_default("optim.steps=1201", [])
    assert is_default("optim.dilation=0.3", ["recipe=paper"]) and not is_default("optim.dilation=0.3", [])
    assert not is_default("optim.no_such=1", []) and not is_default("optim.key_light=1", [])


def commands(path):
    for block in blocks(path):
        for line in re.sub(r"\\\n\s*", "", block).splitlines():
            words = shlex.split(re.sub(r"\$\([^)]*\)", "X", line), comments=True)
            while words and "=" in words[0] and not words[0].startswith("-"):
                words = words[1:]  # of the environment
            if words:
                yield line, words


@pytest.mark.parametrize("path", TODAY, ids=name_of)
def test_commands_compose(path):
    for line, words in commands(path):
        if words[:2] == ["python", "train.py"]:
            overrides = [word for word in words[2:] if "=" in word]
            ours = [word for word in overrides if not word.startswith(("hydra", "+hydra"))]
            # a sweep is tried with the first of each
            first = [word if "[" in word else word.split(",")[0] for word in ours]
            load_settings(composed(*first))
            assert set(words[2:]) - set(overrides) <= {"-m"} | {"--help", "--cfg", "job"}, line
        elif words[:3] == ["python", "-m", "occfusion"]:
            assert words[3] in VERBS, line


def test_launchers_that_pages_name_are_known():
    Plugins.instance()  # of Hydra, which finds the installed launchers
    page = (DOCS / "guide" / "many_runs.md").read_text(encoding="utf-8")
    from occfusion.cli.launchers import missing_launcher

    for launcher in set(re.findall(r"hydra/launcher=(\w+)", page)) - {"ray"}:
        assert missing_launcher([f"hydra/launcher={launcher}"]) is None, launcher


def test_messages_are_those_of_the_code():
    texts = [
        node.value
        for path in sorted((ROOT / "src").rglob("*.py"))
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(node, ast.Constant) and isinstance(node.value, str)
    ]
    page = (DOCS / "guide" / "troubleshooting.md").read_text(encoding="utf-8")
    messages = re.findall(r"^\| `(\w+Error): ([^`]+)` \|", page, re.MULTILINE)
    assert len(messages) > 10
    for _, message in messages:
        for part in re.split(r"…|module\.name|smpl|optim", message):
            words = part.strip()
            assert len(words) < 8 or any(words in text for text in texts), f"no message has {words!r}"


def test_sources_of_layouts_are_those_that_tests_name():
    told = " ".join(path.read_text(encoding="utf-8") for path in (ROOT / "tests" / "upstream").glob("*.py"))
    named = re.findall(r"([\w-]+/[\w.-]+) ?@ ?([0-9a-f]{7,40})", told)
    page = (DOCS / "guide" / "data.md").read_text(encoding="utf-8")
    quoted = re.findall(r"([\w-]+/[\w.-]+)@([0-9a-f]{7,40})", page)
    assert len(quoted) > 8
    for repository, commit in quoted:
        assert any(name == repository and long.startswith(commit) for name, long in named), (
            repository,
            commit,
        )


def test_changelog_has_the_version():
    page = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    versions = re.findall(r"^## \[(\d+\.\d+\.\d+)\] - \d{4}-\d\d-\d\d$", page, re.MULTILINE)
    assert versions[0] == occfusion.__version__
    assert page.index("## [Unreleased]") < page.index(f"## [{versions[0]}]")


def test_guides_and_method_are_short():
    pages = [path for folder in ("guide", "method") for path in (DOCS / folder).glob("*.md")]
    texts = (path.read_text(encoding="utf-8").split() for path in pages)
    words = sum(any(map(str.isalnum, word)) for text in texts for word in text)  # not the lines of tables
    assert words <= MOST_WORDS
    assert len((ROOT / "README.md").read_text(encoding="utf-8").splitlines()) <= 140


def test_nothing_is_said_of_a_day_where_the_present_is_told():
    for folder in ("guide", "method"):
        for path in (DOCS / folder).glob("*.md"):
            assert not re.search(r"20\d\d-\d\d-\d\d|the default before|an earlier revision", prose(path)), (
                name_of(path)
            )
