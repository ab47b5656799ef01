"""Training turns estimated poses towards the true ones, which an embedded person of the hard level has."""

from pathlib import Path

import numpy as np
import pytest
import torch
from hydra import compose, initialize_config_dir

from occfusion.human import Avatar
from occfusion.run import app
from occfusion.run.loaded import load_run
from occfusion.run.prepare import make_body, make_data
from occfusion.synth import SceneSpec, write_scene
from occfusion.synth.scene import Scene

CONF = Path(__file__).parents[2] / "conf"
SPEC = SceneSpec(subject=3, level="hard", image_size=128, frames=24, cameras=2)


@pytest.mark.slow
def test_corrections_bring_the_body_nearer_to_the_true_one(tmp_path: Path) -> None:
    write_scene(tmp_path, SPEC, progress=False)
    overrides = [
        "variant=A", "dataset=zju", f"dataset.root={tmp_path}", f"dataset.scene={SPEC.name}",
        f"body.path={tmp_path / SPEC.name / 'body.npz'}", f"output_dir={tmp_path / 'run'}",
        "dataset.occlusion.kind=none", "dataset.test_frames=[0,10,9]", "trainer.enable_progress_bar=false",
        "optim.steps=250", "optim.lambda_lpips=0", "plan=full", "evaluation.held_out=false",
        "evaluation.training_views=false", "evaluation.curve=false", "evaluation.perceptual=false",
    ]  # fmt: skip
    with initialize_config_dir(str(CONF), version_base="1.3"):
        app.run(compose("config", overrides), folder_chosen_by_user=True)
    run = load_run(tmp_path / "run")
    assert run.avatar.pose_refiner is not None and run.avatar.pose_spline is not None

    body, data = make_body(run.settings.body), make_data(run.settings, make_body(run.settings.body))
    data.setup()
    # Gaussians on the body's vertices follow them exactly: what is left is the difference of poses
    posed = Avatar(body, refine_pose=False, learn_skinning=False, pose_spline=run.avatar.pose_spline)
    posed.pose_refiner = run.avatar.pose_refiner
    given, true = Scene(SPEC), Scene(SPEC)
    true.disk_take = true.take
    view = data.camera(0).viewmat[:3, :3].double().numpy()
    before, after = [], []
    for frame in range(SPEC.frames):
        with torch.no_grad():
            corrected = posed.deform(data.pose(frame)).means.double().numpy()
        wanted = true.parameters(frame).vertices
        before.append((given.parameters(frame).vertices - wanted) @ view.T)
        after.append((corrected - wanted) @ view.T)

    def rms(errors: list[np.ndarray]) -> tuple[float, float]:
        in_plane, along = np.stack(errors)[..., :2], np.stack(errors)[..., 2]
        return float(np.sqrt(np.square(in_plane).mean())), float(np.sqrt(np.square(along).mean()))

    (plane_before, along_before), (plane_after, along_after) = rms(before), rms(after)
    assert plane_before > 0.006  # metres: there is something to mend
    assert plane_after < 0.6 * plane_before
    assert along_after < 1.1 * along_before  # one camera hardly tells; at least nothing drifts
