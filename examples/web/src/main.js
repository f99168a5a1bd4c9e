// SPDX-License-Identifier: GPL-3.0-or-later
// The page: a model that plays on sliders.

import { Model } from "./model.js";
import { fillPanel } from "./panel.js";
import { Pose } from "./pose.js";
import { Stage } from "./stage.js";

async function read(name) {
  const answer = await fetch(name);
  if (!answer.ok) throw new Error(`There is no ${name} beside this page; write it with prepare.py.`);
  return new Uint8Array(await answer.arrayBuffer());
}

/** "busy" until the mesh shows what the sliders say, then "ready"; "failed" with a sentence in the panel. */
function tell(state, sentence) {
  document.body.dataset.state = state;
  document.getElementById("status").textContent = sentence;
}

async function start() {
  tell("busy", "Loading …");
  const model = await Model.load(await read("model.onnx"));
  const triangles = new Uint32Array((await read("triangles.bin")).buffer);
  if (triangles.some((vertex) => vertex >= model.info.vertices)) {
    throw new Error("triangles.bin belongs to another mesh; write both files with prepare.py.");
  }
  const pose = new Pose(model.info);
  const rest = await model.run(pose);
  const stage = new Stage(document.getElementById("view"), triangles, rest.positions);
  const up = document.getElementById("up");
  up.addEventListener("change", () => stage.frame(up.value));
  stage.resize();
  stage.frame(up.value);

  let running = false;
  let joint = 0;
  let newer = false; // the sliders have moved since the run began
  async function play() {
    newer = true;
    if (running) return;
    running = true;
    try {
      while (newer) {
        newer = false;
        const begin = performance.now();
        const { positions, confidence } = await model.run(pose);
        const time = performance.now() - begin;
        stage.show(positions, pose.matrices()[joint]);
        globalThis.positions = positions; // for the console, and for whoever compares them
        if (!newer) tell("ready", `Confidence ${Math.round(confidence * 100)} %, ${time.toFixed(1)} ms`);
      }
    } finally {
      running = false;
    }
  }
  fillPanel(model.info, pose, (inHand) => {
    joint = inHand;
    document.body.dataset.state = "busy";
    play().catch(fail);
  });
}

function fail(error) {
  tell("failed", error.message);
  throw error;
}

start().catch(fail);
