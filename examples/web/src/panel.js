// SPDX-License-Identifier: GPL-3.0-or-later
// The panel beside the mesh: which joint, its three angles, and the controls.

import { MathUtils } from "three";

const AXES = ["x", "y", "z"];
const element = (id) => document.getElementById(id);

/**
 * Fill the panel.
 *
 * @param info the metadata of the model
 * @param {Pose} pose what the sliders set
 * @param {(joint: number) => void} changed called after each change, with the joint in hand
 */
export function fillPanel(info, pose, changed) {
  const select = element("joint");
  info.joints.forEach(({ name }, joint) => {
    if (name) select.append(new Option(name, joint)); // one without a name never moves
  });
  const joint = () => Number(select.value);
  const angles = AXES.map((axis, number) => {
    const slider = new Slider(axis.toUpperCase(), `angle-${axis}`, -180, 180, 1, "°", (value) => {
      pose.degrees[joint()][number] = value;
      changed(joint());
    });
    element("angles").append(slider.row);
    return slider;
  });
  const controls = pose.controls.map(({ path, low, high }, number) => {
    const slider = new Slider(path, `control-${number}`, low, high, "any", "", (value) => {
      pose.values[number] = value;
      changed(joint());
    });
    element("controls").append(slider.row);
    return slider;
  });
  element("controls").hidden = !controls.length;

  const refresh = () => {
    const trained = (info.training?.limits ?? []).filter(
      ({ bone, kind }) => kind === "rotation" && bone === info.joints[joint()].name,
    );
    angles.forEach((slider, axis) => {
      slider.set(pose.degrees[joint()][axis]);
      slider.mark(trained.find((limit) => limit.axis === axis));
    });
    controls.forEach((slider, control) => slider.set(pose.values[control]));
    changed(joint());
  };
  select.addEventListener("change", refresh);
  element("rest").addEventListener("click", () => {
    pose.reset();
    refresh();
  });
  const count = (number, what) => `${number.toLocaleString("en")} ${what}`;
  element("size").textContent = `${count(select.length, "joints")}, ${count(info.vertices, "vertices")}`;
  refresh();
}

/** A labeled slider; `row` is its element. */
class Slider {
  constructor(label, id, low, high, step, unit, changed) {
    this.unit = unit;
    this.row = element("slider").content.firstElementChild.cloneNode(true);
    this.row.firstElementChild.textContent = label;
    this.row.title = label;
    [this.input, this.output] = this.row.querySelectorAll("input, output");
    Object.assign(this.input, { id, min: low, max: high, step });
    this.input.addEventListener("input", () => {
      this.show();
      changed(this.input.valueAsNumber);
    });
  }

  set(value) {
    this.input.value = value;
    this.show();
  }

  show() {
    this.output.textContent = this.unit ? `${this.input.value}${this.unit}` : this.input.valueAsNumber.toFixed(2);
  }

  /** Mark the range, in radians, in which the training drew random poses; none without `limit`. */
  mark(limit) {
    const place = (angle) =>
      `${((MathUtils.radToDeg(angle) - this.input.min) / (this.input.max - this.input.min)) * 100}%`;
    this.input.style.setProperty("--low", limit ? place(limit.low) : "0%");
    this.input.style.setProperty("--high", limit ? place(limit.high) : "0%");
  }
}
