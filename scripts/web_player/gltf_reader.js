// Reads a .glb with the loader of three, poses it and draws it: for tests, which must not trust readers of our own.
import * as THREE from "three";
import { GLTFLoader } from "three/addons/loaders/GLTFLoader.js";

const unpacked = (text) => Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
const packed = (bytes) => {
  let text = "";
  for (let k = 0; k < bytes.length; k += 32768) text += String.fromCharCode(...bytes.subarray(k, k + 32768));
  return btoa(text);
};
let file, mixer, mesh;

// opens a file; returns its motions, each with its seconds, and what it has one of
async function open(base64) {
  file = await new GLTFLoader().parseAsync(unpacked(base64).buffer, "");
  mixer = new THREE.AnimationMixer(file.scene);
  const meshes = [];
  file.scene.traverse((node) => node.isSkinnedMesh && meshes.push(node));
  [mesh] = meshes;
  return {
    meshes: meshes.length, bones: mesh.skeleton.bones.map((bone) => bone.name),
    motions: file.animations.map(({ name, duration }) => ({ name, duration })),
  };
}

// places of all vertices at a moment of a motion, float32 in base64; a bone may be turned about z by hand
function posed(name, seconds, bone = -1, turn = 0) {
  mixer.stopAllAction();
  const action = mixer.clipAction(THREE.AnimationClip.findByName(file.animations, name));
  action.setLoop(THREE.LoopOnce).clampWhenFinished = true;
  action.play();
  mixer.setTime(seconds);
  if (bone >= 0) mesh.skeleton.bones[bone].rotateZ(turn);
  file.scene.updateMatrixWorld(true);
  mesh.skeleton.update();
  const count = mesh.geometry.attributes.position.count, found = new Float32Array(3 * count);
  const place = new THREE.Vector3();
  for (let k = 0; k < count; k++) {
    mesh.localToWorld(mesh.getVertexPosition(k, place)).toArray(found, 3 * k);
  }
  return packed(new Uint8Array(found.buffer));
}

// a picture of what was posed last, by a pinhole camera, as a data address
function draw(view, [fx, fy, cx, cy], width, height) {
  const renderer = new THREE.WebGLRenderer({ antialias: false, preserveDrawingBuffer: true });
  renderer.setSize(width, height, false);
  renderer.setClearColor(0x000000, 1);
  const camera = new THREE.PerspectiveCamera(), near = 0.05, far = 100;
  camera.matrixAutoUpdate = false;
  camera.matrix.set(...view).invert().multiply(new THREE.Matrix4().makeScale(1, -1, -1));
  camera.updateMatrixWorld(true);
  camera.projectionMatrix.set(
    2 * fx / width, 0, 1 - 2 * cx / width, 0, 0, 2 * fy / height, 2 * cy / height - 1, 0,
    0, 0, (near + far) / (near - far), 2 * near * far / (near - far), 0, 0, -1, 0,
  );
  camera.projectionMatrixInverse.copy(camera.projectionMatrix).invert();
  mesh.frustumCulled = false;
  renderer.render(file.scene, camera);
  const address = renderer.domElement.toDataURL("image/png");
  renderer.dispose();
  return address;
}

window.gltfReader = { open, posed, draw };
