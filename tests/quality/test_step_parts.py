from __future__ import annotations

from occfusion.bench.parts import step_parts


def test_every_part_runs_again_and_again():
    calls = step_parts("torch", 200, 48, seed=0)
    assert [name.split(",")[0].split(" ")[0] for name in calls] == [
        "avatar", "avatar", "Adam", "rasteriser", "L1", "SSIM", "ST-LPIPS", "ST-LPIPS",
        "ST-LPIPS", "ST-LPIPS",
        "distillation", "distillation", "the",
    ]  # fmt: skip
    for call in calls.values():
        call()
        call()
