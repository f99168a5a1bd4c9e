// SPDX-License-Identifier: GPL-3.0-or-later
// The page: sliders pose a model.

import { Model } from "./model.js";
import { fillPanel } from "./panel.js";
import { Pose } from "./pose.js";
import { Stage } from "./stage.js";

async function fetchBytes(name) {
  const response = await fetch(name);
  if (!response.ok) throw new Error(`There is no ${name} beside this page; write it with prepare.py.`);
  return new Uint8Array(await response.arrayBuffer());
}

/** Set the state of the page: "busy" until the mesh matches the sliders, "ready", or "failed"; show `sentence`. */
function setState(state, sentence) {
  document.body.dataset.state = state;
  document.getElementById("status").textContent = sentence;
}

async function start() {
  setState("busy", "Loading …");
  const model = await Model.load(await fetchBytes("model.onnx"));
  const triangles = new Uint32Array((await fetchBytes("triangles.bin")).buffer);
  if (triangles.some((vertex) => vertex >= model.info.vertexCount)) {
    throw new Error("triangles.bin belongs to a different mesh; write both files with prepare.py.");
  }
  const pose = new Pose(model.info);
  const rest = await model.run(pose);
  const stage = new Stage(document.getElementById("view"), triangles, rest.positions, model.info.meshes);
  const up = document.getElementById("up");
  up.addEventListener("change", () => stage.frame(up.value));
  stage.resize();
  stage.frame(up.value);

  let running = false;
  let joint = 0;
  let isOutdated = false; // whether the sliders have moved since the run began
  async function play() {
    isOutdated = true;
    if (running) return;
    running = true;
    try {
      while (isOutdated) {
        isOutdated = false;
        const begin = performance.now();
        const { positions, confidence } = await model.run(pose);
        const time = performance.now() - begin;
        stage.show(positions, pose.matrices()[joint]);
        globalThis.positions = positions; // for the console and the tests
        if (!isOutdated) setState("ready", `Confidence ${Math.round(confidence * 100)} %, ${time.toFixed(1)} ms`);
      }
    } finally {
      running = false;
    }
  }
  const onChange = (chosenJoint) => {
    joint = chosenJoint;
    document.body.dataset.state = "busy";
    play().catch(fail);
  };
  fillPanel(model.info, pose, onChange, (mesh, isShown) => stage.showMesh(mesh, isShown));
}

function fail(error) {
  setState("failed", error.message);
  throw error;
}

start().catch(fail);
