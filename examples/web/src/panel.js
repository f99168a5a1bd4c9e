// SPDX-License-Identifier: GPL-3.0-or-later
// The panel beside the meshes: a list of joints, three angle sliders, a slider for each control, and a box for each mesh.

import { MathUtils } from "three";

const AXES = ["x", "y", "z"];
const element = (id) => document.getElementById(id);

/**
 * Fill the panel.
 *
 * @param info the metadata of the model
 * @param {Pose} pose the pose that the sliders change
 * @param {(joint: number) => void} onChange called after each change with the index of the chosen joint
 * @param {(mesh: number, isShown: boolean) => void} onShow called when a mesh is shown or hidden
 */
export function fillPanel(info, pose, onChange, onShow) {
  const select = element("joint");
  info.joints.forEach(({ name }, joint) => {
    if (name) select.append(new Option(name, joint)); // a joint without a name never moves
  });
  const chosenJoint = () => Number(select.value);
  const angles = AXES.map((axis, number) => {
    const slider = new Slider(axis.toUpperCase(), `angle-${axis}`, -180, 180, 1, "°", (value) => {
      pose.degrees[chosenJoint()][number] = value;
      onChange(chosenJoint());
    });
    element("angles").append(slider.row);
    return slider;
  });
  const controls = pose.controls.map(({ owner, path, low, high }, number) => {
    const slider = new Slider(shortName(path), `control-${number}`, low, high, "any", "", (value) => {
      pose.values[number] = value;
      onChange(chosenJoint());
    });
    slider.row.title = `${owner}/${path}`;
    element("controls").append(slider.row);
    return slider;
  });
  element("controls").hidden = !controls.length;
  info.meshes.forEach(({ name }, mesh) => {
    const row = element("mesh").content.firstElementChild.cloneNode(true);
    const [box, label] = row.children;
    [box.id, label.textContent] = [`mesh-${mesh}`, name];
    box.addEventListener("change", () => onShow(mesh, box.checked));
    element("meshes").append(row);
  });
  element("meshes").hidden = info.meshes.length < 2;

  const refresh = () => {
    const trainedLimits = (info.training?.limits ?? []).filter(
      ({ bone, kind }) => kind === "rotation" && bone === info.joints[chosenJoint()].name,
    );
    angles.forEach((slider, axis) => {
      slider.set(pose.degrees[chosenJoint()][axis]);
      slider.markRange(trainedLimits.find((limit) => limit.axis === axis));
    });
    controls.forEach((slider, control) => slider.set(pose.values[control]));
    onChange(chosenJoint());
  };
  select.addEventListener("change", refresh);
  element("rest").addEventListener("click", () => {
    pose.reset();
    refresh();
  });
  const count = (number, what) => `${number.toLocaleString("en")} ${what}`;
  element("size").textContent = `${count(select.length, "joints")}, ${count(info.vertexCount, "vertices")}`;
  refresh();
}

/** Return the name of a shape key or custom property: "smile" for key_blocks["smile"].value; else the path. */
function shortName(path) {
  const name = path.match(/^(?:key_blocks)?\[("(?:[^"\\]|\\.)*")\](?:\.value)?$/);
  return name ? JSON.parse(name[1]) : path;
}

/** A labeled slider; `row` is its HTML element. */
class Slider {
  constructor(label, id, low, high, step, unit, onChange) {
    this.unit = unit;
    this.row = element("slider").content.firstElementChild.cloneNode(true);
    this.row.firstElementChild.textContent = label;
    [this.input, this.output] = this.row.querySelectorAll("input, output");
    Object.assign(this.input, { id, min: low, max: high, step });
    this.input.addEventListener("input", () => {
      this.show();
      onChange(this.input.valueAsNumber);
    });
  }

  set(value) {
    this.input.value = value;
    this.show();
  }

  show() {
    this.output.textContent = this.unit ? `${this.input.value}${this.unit}` : this.input.valueAsNumber.toFixed(2);
  }

  /** Mark the range of the random training poses, radians; without `limit`, remove the mark. */
  markRange(limit) {
    const positionOf = (angle) =>
      `${((MathUtils.radToDeg(angle) - this.input.min) / (this.input.max - this.input.min)) * 100}%`;
    this.input.style.setProperty("--low", limit ? positionOf(limit.low) : "0%");
    this.input.style.setProperty("--high", limit ? positionOf(limit.high) : "0%");
  }
}
