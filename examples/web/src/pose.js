// SPDX-License-Identifier: GPL-3.0-or-later
// Forward kinematics: computes the inputs of the model from the angles of the joints.

import { Euler, MathUtils, Matrix4 } from "three";

const ORDER = "ZYX"; // three.js names the last rotation first: this is Blender's order XYZ

/** A pose of the joints of a model. */
export class Pose {
  /** @param info the metadata of the model */
  constructor(info) {
    this.joints = info.joints;
    this.degrees = info.joints.map(() => [0, 0, 0]);
    this.rest = info.rest_matrices.map((rows) => new Matrix4().set(...rows));
    this.fromParent = info.joints.map(({ parent }, joint) =>
      parent < 0 ? this.rest[joint] : this.rest[parent].clone().invert().multiply(this.rest[joint]),
    );
    this.controls = info.controls ?? [];
    this.values = this.controls.map(defaultValue);
  }

  /** Reset to the rest pose. */
  reset() {
    this.degrees.forEach((angles) => angles.fill(0));
    this.values = this.controls.map(defaultValue);
  }

  /** Return the pose matrices of the joints, mesh-object space, meters. Every parent comes before its children. */
  matrices() {
    const posed = [];
    this.joints.forEach(({ parent }, joint) => {
      const angles = this.degrees[joint].map(MathUtils.degToRad);
      const rotation = new Matrix4().makeRotationFromEuler(new Euler(...angles, ORDER));
      const matrix = parent < 0 ? new Matrix4() : posed[parent].clone();
      posed.push(matrix.multiply(this.fromParent[joint]).multiply(rotation));
    });
    return posed;
  }
}

/** Return the default of a control: the value in its range nearest to 0. */
function defaultValue({ low, high }) {
  return MathUtils.clamp(0, low, high);
}
