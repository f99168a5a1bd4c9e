// SPDX-License-Identifier: GPL-3.0-or-later
// Runs a model with ONNX Runtime.

import * as ort from "onnxruntime-web/wasm";
import wasm from "onnxruntime-web/ort-wasm-simd-threaded.wasm";
import { readInfo } from "./metadata.js";

ort.env.wasm.numThreads = 1; // more threads need a cross-origin isolated page
ort.env.wasm.wasmPaths = { wasm: new URL(wasm, import.meta.url).href };

/** A loaded model; `info` is its metadata. */
export class Model {
  /** @param {Uint8Array} bytes the .onnx file */
  static async load(bytes) {
    const model = new Model();
    model.info = readInfo(bytes);
    model.session = await ort.InferenceSession.create(bytes);
    return model;
  }

  /**
   * Deform the mesh.
   *
   * @param {Pose} pose
   * @returns `positions`, Float32Array of x, y, z for each vertex in mesh-object space, meters, and `confidence`, the lowest
   *     confidence of the partitions, 0 to 1
   */
  async run(pose) {
    const count = pose.joints.length;
    const matrices = new Float32Array(16 * count);
    pose.matrices().forEach((matrix, joint) => matrix.transpose().toArray(matrices, 16 * joint)); // row by row
    const inputs = { pose_matrices: new ort.Tensor("float32", matrices, [1, count, 4, 4]) };
    if (pose.controls.length) {
      inputs.controls = new ort.Tensor("float32", Float32Array.from(pose.values), [1, pose.values.length]);
    }
    const { positions, confidence } = await this.session.run(inputs);
    return { positions: positions.data, confidence: Math.min(...confidence.data) };
  }
}
