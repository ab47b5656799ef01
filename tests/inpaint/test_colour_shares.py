"""Steps of colours that few frames show: shorter by a share for each vertex, all else untouched."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

from occfusion.files.run_folder import RunFolder
from occfusion.human import embedded_body
from occfusion.human.avatar import Avatar
from occfusion.human.rendering import Renderer
from occfusion.settings.stages import RefineSettings
from occfusion.stages.references import References
from occfusion.stages.refine import RefineStage
from occfusion.stages.targets import UncertainMasks


def steps(folder: Path, shares: Tensor | None) -> list[dict[str, Tensor]]:
    """Returns an avatar's parameters before, between and after two steps by gradients that do not depend on them."""
    avatar = Avatar(embedded_body(), sh_degree=1)
    references = References(RunFolder(folder).inpainted, frozenset())
    stage = RefineStage(
        avatar, RefineSettings(lambda_lpips=0.0, densify=False), references, UncertainMasks({}, {}), {},
        perceptual=None, densifier=None, renderer=Renderer("torch"), seed=0, steps_before=0, colour_shares=shares,
    )  # fmt: skip
    adam = stage.configure_optimizers()
    generator = torch.Generator().manual_seed(0)
    found = []

    def look() -> None:
        found.append({name: value.detach().clone() for name, value in avatar.gaussians.named_parameters()})

    look()
    for _ in range(2):
        for value in avatar.gaussians.parameters():
            value.grad = torch.randn(value.shape, generator=generator)
        adam.step()
        look()
    return found


@pytest.fixture
def shares() -> Tensor:
    return torch.rand(len(embedded_body().da_vertices()), generator=torch.Generator().manual_seed(1))


def test_colours_go_their_share_of_each_step(tmp_path: Path, shares: Tensor) -> None:
    """Adam's step does not depend on the parameters, so that shares multiply it."""
    plain, shared = steps(tmp_path, None), steps(tmp_path, shares)
    rows = Avatar(embedded_body(), sh_degree=1).gaussians.vertex_index
    for before, after in ((0, 1), (1, 2)):
        for name in plain[0]:
            moved, less = (found[after][name] - found[before][name] for found in (plain, shared))
            if name in ("sh0", "sh_rest"):
                assert_close(less, moved * shares[rows][:, None, None], rtol=1e-3, atol=1e-7)
            else:
                assert torch.equal(less, moved), name


@pytest.mark.parametrize("share", [0.0, 1.0])
def test_no_share_keeps_colours_and_a_whole_one_changes_nothing(tmp_path: Path, share: float) -> None:
    plain = steps(tmp_path, None)
    shared = steps(tmp_path, torch.full((len(embedded_body().da_vertices()),), share))
    expected = plain[-1] if share else plain[0]
    for name in ("sh0", "sh_rest"):
        assert torch.equal(shared[-1][name], expected[name])
        assert not torch.equal(plain[-1][name], plain[0][name])
