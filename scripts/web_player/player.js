// The page of an animatable avatar: Gaussians at rest, four bones each, skinned on the visitor's GPU.
import * as THREE from "three";
import { OrbitControls } from "three/addons/controls/OrbitControls.js";
import { SparkRenderer, SplatMesh, SplatSkinning, SplatSkinningMode } from "@sparkjsdev/spark";

const MOST_SPREAD = Math.sqrt(2 * Math.log(255)); // where an opaque Gaussian has faded to 1/255

async function start(data) {
  const { about, ply, bones, weights, motions } = data;
  const canvas = document.getElementById("view");
  const renderer = new THREE.WebGLRenderer({ canvas, antialias: false, preserveDrawingBuffer: true });
  renderer.setClearColor(0x000000, 1);
  const scene = new THREE.Scene();
  const camera = new THREE.PerspectiveCamera(40, 1, 0.05, 100);
  const spark = new SparkRenderer({
    renderer, covSplats: true, accumExtSplats: true, sortRadial: false, maxStdDev: MOST_SPREAD,
    minAlpha: 1 / 255, preBlurAmount: about.dilation, blurAmount: 0, minPixelRadius: 0,
  });
  scene.add(spark);
  const mesh = new SplatMesh({ fileBytes: ply, fileName: "avatar.ply", extSplats: true, covSplats: true });
  await mesh.initialized;
  const skinning = new SplatSkinning({
    mesh, numSplats: about.gaussians, numBones: about.bones, mode: SplatSkinningMode.LINEAR_BLEND,
  });
  for (let k = 0; k < about.gaussians; k++) {
    const i = new THREE.Vector4(...bones.subarray(4 * k, 4 * k + 4));
    const w = new THREE.Vector4(...weights.subarray(4 * k, 4 * k + 4)).divideScalar(255);
    skinning.setSplatBones(k, i, w);
  }
  mesh.skinning = skinning;
  mesh.updateGenerator();
  scene.add(mesh);

  const matrix = new THREE.Matrix4();
  let motion = 0, frame = 0, shown = -1;
  function pose(which, at) {
    motion = which; frame = at;
    const table = motions[which].matrices, start = at * about.bones * 12;
    for (let b = 0; b < about.bones; b++) {
      const m = table.subarray(start + 12 * b, start + 12 * b + 12);
      // rest stays the identity: what is handed over is the whole skinning matrix
      matrix.set(...m, 0, 0, 0, 1);
      skinning.setBoneMatrix(b, matrix);
    }
    skinning.updateBones();
    // the footprint belongs to the person: it grows with the picture
    shown = at;
  }
  function footprint(focal, distance) {
    const scale = (focal / distance) * about.pixel;
    spark.preBlurAmount = about.dilation * scale * scale + Math.max(0, 1 - scale * scale) / 12;
  }

  const controls = new OrbitControls(camera, canvas);
  controls.target.set(0, 0.95, 0);
  camera.position.set(0, 1.1, 3.4);
  controls.update();
  let playing = true, driven = false, last = performance.now(), time = 0, pictures = 0, since = last;
  const slider = document.getElementById("frame"), choice = document.getElementById("motion");
  const button = document.getElementById("play"), rate = document.getElementById("rate");
  motions.forEach((m, k) => choice.add(new Option(m.name, k)));
  const choose = (k) => { slider.max = motions[k].frames - 1; time = 0; pose(k, 0); };
  choice.onchange = () => choose(Number(choice.value));
  button.onclick = () => { playing = !playing; button.textContent = playing ? "pause" : "play"; };
  slider.oninput = () => { playing = false; button.textContent = "play"; time = slider.value / motions[motion].fps; };
  document.getElementById("about").textContent = about.text;
  choose(0);

  function loop(now) {
    requestAnimationFrame(loop);
    if (driven) return;
    const m = motions[motion];
    if (playing) time += (now - last) / 1000;
    last = now;
    const at = Math.floor(time * m.fps + 1e-6) % m.frames;
    if (at !== shown) pose(motion, at);
    slider.value = at;
    const width = innerWidth, height = innerHeight;
    if (canvas.width !== width || canvas.height !== height) renderer.setSize(width, height, false);
    camera.aspect = width / height;
    camera.updateProjectionMatrix();
    controls.update();
    footprint(0.5 * height / Math.tan(0.5 * camera.fov * Math.PI / 180), camera.position.distanceTo(controls.target));
    renderer.render(scene, camera);
    pictures += 1;
    if (now - since > 1000) { rate.textContent = `${Math.round(1000 * pictures / (now - since))} fps`; pictures = 0; since = now; }
  }
  requestAnimationFrame(loop);

  // one picture by a pinhole camera: for tests, and for whoever makes pictures with the page
  async function draw(which, at, view, K, width, height, scale) {
    driven = true;
    pose(which, at);
    spark.preBlurAmount = about.dilation * scale * scale + Math.max(0, 1 - scale * scale) / 12;
    renderer.setSize(width, height, false);
    const own = new THREE.PerspectiveCamera();
    const near = 0.05, far = 100, [fx, fy, cx, cy] = K;
    own.matrixAutoUpdate = false;
    own.projectionMatrix.makePerspective(-cx * near / fx, (width - cx) * near / fx, cy * near / fy, (cy - height) * near / fy, near, far);
    own.projectionMatrixInverse.copy(own.projectionMatrix).invert();
    matrix.set(...view);
    own.matrix.copy(new THREE.Matrix4().makeScale(1, -1, -1).multiply(matrix)).invert();
    own.matrix.decompose(own.position, own.quaternion, own.scale);
    own.updateMatrixWorld(true);
    // positions and order follow by a few pictures: the sorting is a worker's
    for (let k = 0; k < 12; k++) {
      renderer.render(scene, own);
      await new Promise((done) => setTimeout(done, 60));
    }
    renderer.render(scene, own);
    return canvas.toDataURL("image/png");
  }
  window.occfusion = { draw, about, motions: motions.map(({ name, frames, fps }) => ({ name, frames, fps })) };
}
window.occfusionStart = start;
