// SPDX-License-Identifier: GPL-3.0-or-later
// Forward kinematics: from the angles of the joints to what the model takes.

import { Euler, MathUtils, Matrix4 } from "three";

const ORDER = "ZYX"; // three.js names the axes outermost first: about X, then Y, then Z, Blender's XYZ

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
    this.values = this.controls.map(atRest);
  }

  /** Back to the rest pose. */
  reset() {
    this.degrees.forEach((angles) => angles.fill(0));
    this.values = this.controls.map(atRest);
  }

  /** Pose matrices of the joints, mesh-object space, meters; every parent stands before its children. */
  matrices() {
    const posed = [];
    this.joints.forEach(({ parent }, joint) => {
      const angles = this.degrees[joint].map(MathUtils.degToRad);
      const turn = new Matrix4().makeRotationFromEuler(new Euler(...angles, ORDER));
      const place = parent < 0 ? new Matrix4() : posed[parent].clone();
      posed.push(place.multiply(this.fromParent[joint]).multiply(turn));
    });
    return posed;
  }
}

/** Where a control stands that nobody has set: 0, or what of its range is nearest. */
function atRest({ low, high }) {
  return MathUtils.clamp(0, low, high);
}
