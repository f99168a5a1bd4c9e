// SPDX-License-Identifier: GPL-3.0-or-later
// What is seen: the mesh, a floor, the axes of the joint in hand, and a camera that turns around them.

import {
  AxesHelper,
  Box3,
  BufferAttribute,
  BufferGeometry,
  Color,
  DirectionalLight,
  DoubleSide,
  DynamicDrawUsage,
  GridHelper,
  HemisphereLight,
  MathUtils,
  Mesh,
  MeshStandardMaterial,
  PerspectiveCamera,
  Scene,
  Sphere,
  Vector3,
  WebGLRenderer,
} from "three";
import { OrbitControls } from "three/addons/controls/OrbitControls.js";

const BACKGROUND = 0x24272c;
const AXES = [0xff7a6b, 0x7ed77e, 0x7fb0ff]; // as in the panel
const LIGHTS = [
  [2.4, -0.8, 1, 0.5], // strength and where it comes from, as the camera sees it: from the left and above
  [0.8, 1, 0.2, -0.6], // along the edge on the right
];
const VIEW = { Z: [0.55, -1, 0.4], Y: [0.55, 0.4, 1] }; // from the front, the left and above

export class Stage {
  /**
   * @param {HTMLCanvasElement} canvas fills its parent
   * @param {Uint32Array} triangles three vertices each
   * @param {Float32Array} positions the rest pose, meters
   */
  constructor(canvas, triangles, positions) {
    this.renderer = new WebGLRenderer({ canvas, antialias: true });
    this.renderer.setPixelRatio(devicePixelRatio);
    this.scene = new Scene();
    this.scene.background = new Color(BACKGROUND);
    this.camera = new PerspectiveCamera(35);
    this.scene.add(this.camera, new HemisphereLight(0xdfe8f5, 0x3c3a38, 0.9));
    for (const [strength, ...place] of LIGHTS) {
      const light = new DirectionalLight(0xffffff, strength);
      light.position.set(...place);
      this.camera.add(light);
    }

    this.geometry = new BufferGeometry();
    this.geometry.setIndex(new BufferAttribute(triangles, 1));
    this.geometry.setAttribute("position", new BufferAttribute(positions.slice(), 3).setUsage(DynamicDrawUsage));
    this.geometry.computeVertexNormals();
    const gray = new MeshStandardMaterial({ color: 0xc4c4c4, roughness: 0.55, side: DoubleSide });
    const mesh = new Mesh(this.geometry, gray);
    mesh.frustumCulled = false; // its bounds would have to follow each pose
    this.box = new Box3().setFromBufferAttribute(this.geometry.getAttribute("position"));
    this.sphere = this.box.getBoundingSphere(new Sphere());

    this.axes = new AxesHelper(this.sphere.radius * 0.18);
    this.axes.setColors(...AXES.map((color) => new Color(color)));
    this.axes.matrixAutoUpdate = false;
    this.axes.material.depthTest = false;
    this.axes.renderOrder = 1;
    this.floor = new GridHelper(this.sphere.radius * 3, 12, 0x464b53, 0x363a41);
    this.scene.add(mesh, this.axes, this.floor);

    this.orbit = new OrbitControls(this.camera, canvas);
    this.orbit.addEventListener("change", () => this.draw());
    new ResizeObserver(() => this.resize()).observe(canvas.parentElement);
  }

  /** Show the mesh, and the axes of a joint at its pose matrix. */
  show(positions, joint) {
    const attribute = this.geometry.getAttribute("position");
    attribute.array.set(positions);
    attribute.needsUpdate = true;
    this.geometry.computeVertexNormals();
    // The joint may be scaled, as in a rig that was built in centimeters; its axes keep their length.
    const columns = [new Vector3(), new Vector3(), new Vector3()];
    joint.extractBasis(...columns);
    this.axes.matrix.makeBasis(...columns.map((column) => column.normalize())).copyPosition(joint);
    this.draw();
  }

  /** Look at the whole mesh; `up` is the axis of the mesh that points upwards, "Z" or "Y". */
  frame(up) {
    const { center, radius } = this.sphere;
    this.camera.up.set(0, up === "Y" ? 1 : 0, up === "Z" ? 1 : 0);
    this.floor.rotation.x = up === "Z" ? Math.PI / 2 : 0;
    this.floor.position.copy(center);
    this.floor.position[up.toLowerCase()] = this.box.min[up.toLowerCase()];
    const half = Math.tan(MathUtils.degToRad(this.camera.fov / 2)) * Math.min(1, this.camera.aspect);
    const distance = radius / Math.sin(Math.atan(half));
    this.camera.position
      .set(...VIEW[up])
      .setLength(distance)
      .add(center);
    this.camera.near = distance / 100;
    this.camera.far = distance * 20;
    this.camera.updateProjectionMatrix();
    this.orbit.target.copy(center);
    this.orbit.update();
    this.draw();
  }

  resize() {
    const { clientWidth, clientHeight } = this.renderer.domElement.parentElement;
    this.renderer.setSize(clientWidth, clientHeight);
    this.camera.aspect = clientWidth / clientHeight;
    this.camera.updateProjectionMatrix();
    this.draw();
  }

  draw() {
    this.renderer.render(this.scene, this.camera);
  }
}
