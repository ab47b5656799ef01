"""One HTML file that plays an avatar, skinned on the visitor's GPU; nothing comes from the network.

The Gaussians lie at rest with four bones each. `SplatSkinning` of `@sparkjsdev/spark` 2.2.0 moves a covariance by the
blend of its bones' matrices, as `geometry.skinning` does; weights are rounded to 1/255, and what the blend shapes of a
pose do, where the body has any, is left out.
"""

from __future__ import annotations

import base64
import gzip
import html
import json
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import replace
from importlib.resources import files
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from occfusion.export.splats import FAINTEST, splat_table
from occfusion.files.atomic import write_bytes
from occfusion.files.bodyfile import NUM_JOINTS
from occfusion.files.ply import write_ply
from occfusion.geometry.skinning import bone_transforms
from occfusion.human import Avatar
from occfusion.motion import USUAL_FPS, Performance

PLAYER, LICENCES = "web_player.js.gz", "web_player.LICENSE.txt"
BONES_PER_SPLAT = 4


@torch.no_grad()
def write_page(
    path: Path, avatar: Avatar, performances: Sequence[Performance], *, title: str, pixel: float
) -> None:
    """Writes the page, whole or not at all; its light is even.

    Args:
        path: the `.html` file.
        avatar: whose lamp does not show.
        performances: motions to choose from.
        title: what the page is called.
        pixel: what a pixel of the training pictures covers at the person, metres.

    Raises:
        DataError: the disk refuses.
    """
    betas = performances[0].betas
    rotations, _ = avatar._corrected(performances[0].pose(0))
    binding = avatar._binding()
    _, offsets = avatar._shaped(
        betas, rotations if avatar.body.posedirs is None else avatar.body.da_rotations()
    )
    linear = binding.rest_maps[:, :3].permute(2, 0, 1)
    means = (linear @ avatar.gaussians.means[:, :, None])[:, :, 0] + binding.rest_maps[:, 3].T + offsets
    roots = linear @ avatar.gaussians.roots()
    opacities = avatar.gaussians.opacities
    sh = avatar.gaussians.sh(0)
    table = splat_table(means, roots @ roots.transpose(1, 2), opacities, sh, 0.0)
    table = replace(table, about="at rest, even light")
    kept = opacities >= FAINTEST
    bones, weights = four_bones(binding.weights[kept])
    with tempfile.TemporaryDirectory() as folder:
        write_ply(Path(folder) / "rest.ply", table)
        ply = (Path(folder) / "rest.ply").read_bytes()
    motions = [(each, bone_matrices(avatar, each)) for each in performances]
    rest = "" if avatar.active_sh_degree == 0 else "; colours without their change by direction"
    about = {
        "gaussians": len(table.means), "bones": NUM_JOINTS, "dilation": avatar.dilation, "pixel": pixel,
        "text": f"{title}: {len(table.means)} Gaussians, even light{rest}",
    }  # fmt: skip
    record = {
        "about": about,
        "motions": [
            {"name": each.clip.name, "fps": each.clip.fps or USUAL_FPS, "frames": len(each)}
            for each, _ in motions
        ],
    }
    blobs = [ply, bones.tobytes(), weights.tobytes(), *(m.astype("<f4").tobytes() for _, m in motions)]
    assets = files("occfusion") / "assets"
    player, licences = (assets / PLAYER).read_bytes(), (assets / LICENCES).read_text(encoding="utf-8")
    write_bytes(path, _page(title, record, blobs, player, licences).encode())


def four_bones(weights: Tensor) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    """Returns the four strongest bones of each Gaussian and their weights in 255ths, which sum to 255.

    Args:
        weights: `[N, 24]`, rows sum to 1.
    """
    strongest = weights.topk(BONES_PER_SPLAT, dim=1)
    share = 255 * (strongest.values / strongest.values.sum(dim=1, keepdim=True)).double().numpy()
    whole = np.floor(share)
    missing = (255 - whole.sum(axis=1)).round().astype(int)
    order = np.argsort(whole - share, axis=1)  # the largest remainders first
    rank = np.argsort(order, axis=1)
    whole += rank < missing[:, None]
    return strongest.indices.numpy().astype(np.uint8), whole.astype(np.uint8)


@torch.no_grad()
def bone_matrices(avatar: Avatar, performance: Performance) -> NDArray[np.float64]:
    """Returns the map of each bone from rest to the upright frame, frame by frame, `[T, 24, 3, 4]`."""
    rest = avatar.body.rest(performance.betas)
    out = []
    for row in range(len(performance)):
        rotations, transl = avatar._corrected(performance.pose(row))
        maps = bone_transforms(rotations, rest.joints, avatar.body.parents)
        maps[:, :3, 3] += transl
        out.append((performance.upright @ maps)[:, :3].double().numpy())
    return np.asarray(out)


def _page(
    title: str, record: Mapping[str, object], blobs: Sequence[bytes], player: bytes, licences: str
) -> str:
    def packed(content: bytes) -> str:
        return base64.b64encode(content).decode()

    data = "\n".join(
        f'<script type="application/octet-stream" id="blob{k}">{packed(gzip.compress(blob, 9, mtime=0))}</script>'
        for k, blob in enumerate(blobs)
    )
    said = json.dumps(record).replace("<", "\\u003c")
    return f"""<!doctype html>
<!--
{licences}-->
<html lang="en"><head><meta charset="utf-8"><title>{html.escape(title)}</title>
<meta name="viewport" content="width=device-width, initial-scale=1">
<style>html,body{{margin:0;height:100%;overflow:hidden;background:#000;color:#ddd;font:13px sans-serif}}
canvas{{display:block}}#bar{{position:fixed;left:8px;right:8px;bottom:8px;display:flex;gap:8px;align-items:center}}
#frame{{flex:1}}#about{{position:fixed;left:8px;top:8px}}</style></head>
<body><canvas id="view"></canvas><div id="about">loading</div>
<div id="bar"><button id="play">pause</button><select id="motion"></select>
<input id="frame" type="range" min="0" value="0"><span id="rate"></span></div>
{data}
<script type="application/octet-stream" id="player">{packed(player)}</script>
<script type="application/json" id="record">{said}</script>
<script>
(async () => {{
  const bytes = async (id) => {{
    const packed = Uint8Array.from(atob(document.getElementById(id).textContent), (c) => c.charCodeAt(0));
    const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream("gzip"));
    return new Uint8Array(await new Response(stream).arrayBuffer());
  }};
  try {{
    const record = JSON.parse(document.getElementById("record").textContent);
    const script = document.createElement("script");
    script.textContent = new TextDecoder().decode(await bytes("player"));
    document.head.append(script);
    const motions = [];
    for (const [k, motion] of record.motions.entries())
      motions.push({{...motion, matrices: new Float32Array((await bytes("blob" + (k + 3))).buffer)}});
    await occfusionStart({{about: record.about, ply: await bytes("blob0"), bones: await bytes("blob1"),
      weights: await bytes("blob2"), motions}});
  }} catch (error) {{
    document.getElementById("about").textContent = "this page needs WebGL 2 and DecompressionStream: " + error;
    window.occfusionError = String(error);
  }}
}})();
</script></body></html>
"""
