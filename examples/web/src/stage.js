// SPDX-License-Identifier: GPL-3.0-or-later
// The 3D view: the meshes, a floor, the axes of the chosen joint, and a camera that orbits around them.

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
const AXIS_COLORS = [0xff7a6b, 0x7ed77e, 0x7fb0ff]; // the colors of the panel
const SHADES = [1, 0.7, 0.85]; // of the meshes, in turns
const LIGHTS = [
  [2.4, -0.8, 1, 0.5], // strength and direction in camera space: from the left and above
  [0.8, 1, 0.2, -0.6], // rim light from the right
];
const VIEW_DIRECTIONS = { Z: [0.55, -1, 0.4], Y: [0.55, 0.4, 1] }; // from the front, the left and above

export class Stage {
  /**
   * @param {HTMLCanvasElement} canvas fills its parent
   * @param {Uint32Array} triangles three vertices each
   * @param {Float32Array} positions vertex positions in the rest pose, meters
   * @param meshes the meshes of the metadata; the triangles and positions of each follow those of the one before
   */
  constructor(canvas, triangles, positions, meshes) {
    this.renderer = new WebGLRenderer({ canvas, antialias: true });
    this.renderer.setPixelRatio(devicePixelRatio);
    this.scene = new Scene();
    this.scene.background = new Color(BACKGROUND);
    this.camera = new PerspectiveCamera(35);
    this.scene.add(this.camera, new HemisphereLight(0xdfe8f5, 0x3c3a38, 0.9));
    for (const [strength, ...direction] of LIGHTS) {
      const light = new DirectionalLight(0xffffff, strength);
      light.position.set(...direction);
      this.camera.add(light);
    }

    this.geometry = new BufferGeometry();
    this.geometry.setIndex(new BufferAttribute(triangles, 1));
    this.geometry.setAttribute("position", new BufferAttribute(positions.slice(), 3).setUsage(DynamicDrawUsage));
    this.geometry.computeVertexNormals();
    this.materials = meshes.map((_, mesh) => {
      const color = new Color(0xc4c4c4).multiplyScalar(SHADES[mesh % SHADES.length]);
      return new MeshStandardMaterial({ color, roughness: 0.55, side: DoubleSide });
    });
    let [start, vertices] = [0, 0]; // of the next mesh: its first corner and its first vertex
    meshes.forEach((mesh, number) => {
      vertices += mesh.vertices;
      const next = triangles.findIndex((vertex, corner) => corner >= start && vertex >= vertices);
      const end = next < 0 ? triangles.length : next;
      this.geometry.addGroup(start, end - start, number);
      start = end;
    });
    const mesh = new Mesh(this.geometry, this.materials);
    mesh.frustumCulled = false; // frustum culling would need new bounds for each pose
    this.box = new Box3().setFromBufferAttribute(this.geometry.getAttribute("position"));
    this.sphere = this.box.getBoundingSphere(new Sphere());

    this.axes = new AxesHelper(this.sphere.radius * 0.18);
    this.axes.setColors(...AXIS_COLORS.map((color) => new Color(color)));
    this.axes.matrixAutoUpdate = false;
    this.axes.material.depthTest = false;
    this.axes.renderOrder = 1;
    this.floor = new GridHelper(this.sphere.radius * 3, 12, 0x464b53, 0x363a41);
    this.scene.add(mesh, this.axes, this.floor);

    this.orbit = new OrbitControls(this.camera, canvas);
    this.orbit.addEventListener("change", () => this.draw());
    new ResizeObserver(() => this.resize()).observe(canvas.parentElement);
  }

  /** Show or hide a mesh. */
  showMesh(mesh, isShown) {
    this.materials[mesh].visible = isShown;
    this.draw();
  }

  /** Show the meshes, and axes at the pose matrix of a joint. */
  show(positions, joint) {
    const attribute = this.geometry.getAttribute("position");
    attribute.array.set(positions);
    attribute.needsUpdate = true;
    this.geometry.computeVertexNormals();
    // Normalize the axes, because a joint may be scaled, for example in a rig that was built in centimeters.
    const columns = [new Vector3(), new Vector3(), new Vector3()];
    joint.extractBasis(...columns);
    this.axes.matrix.makeBasis(...columns.map((column) => column.normalize())).copyPosition(joint);
    this.draw();
  }

  /** Frame the whole mesh in the view; `up` is the axis of the mesh that points up, "Z" or "Y". */
  frame(up) {
    const { center, radius } = this.sphere;
    this.camera.up.set(0, up === "Y" ? 1 : 0, up === "Z" ? 1 : 0);
    this.floor.rotation.x = up === "Z" ? Math.PI / 2 : 0;
    this.floor.position.copy(center);
    this.floor.position[up.toLowerCase()] = this.box.min[up.toLowerCase()];
    const halfExtent = Math.tan(MathUtils.degToRad(this.camera.fov / 2)) * Math.min(1, this.camera.aspect);
    const distance = radius / Math.sin(Math.atan(halfExtent));
    this.camera.position
      .set(...VIEW_DIRECTIONS[up])
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
