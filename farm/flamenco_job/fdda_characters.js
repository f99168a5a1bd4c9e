// SPDX-License-Identifier: GPL-3.0-or-later
//
// A job type for Flamenco: records, trains and binds the characters of a plan of FDDA for Blender. Copy this file into the
// folder `scripts` beside flamenco-manager; docs/farm.md says how a job is sent.
//
// The graph comes with the job, from `python -m fdda_addon farm characters.toml --flamenco job.json`. Tasks that run Blender
// have the type "blender", those that train "misc", or "fdda-gpu" where the plan asks for a GPU.

const JOB_TYPE = {
    label: "FDDA characters",
    settings: [
        { key: "plan", type: "string", subtype: "file_path", required: true, visible: "web",
          description: "characters.toml, in a folder that all workers see" },
        { key: "python", type: "string", required: true, visible: "web",
          description: "Python of the workers that has the packages of the project" },
        { key: "project", type: "string", subtype: "dir_path", required: true, visible: "web",
          description: "The folder of FDDA for Blender on the workers" },
        { key: "gpu", type: "bool", default: false, visible: "web",
          description: "Trainings go to workers that have the task type fdda-gpu" },
        { key: "graph", type: "string", required: true, visible: "hidden",
          description: "Tasks, as farm --flamenco writes them" },
    ]
};

const TYPES = {
    influences: "blender", record: "blender", merge: "file-management", train: "misc",
    evaluate: "blender", refine: "blender", bind: "blender",
};

function compileJob(job) {
    const settings = job.settings;
    const graph = JSON.parse(settings.graph);
    if (!Array.isArray(graph) || graph.length === 0) {
        throw "The setting graph has no tasks; write the job with farm --flamenco.";
    }
    const made = {};
    const bound = [];
    for (const node of graph) {
        if (!Object.hasOwn(TYPES, node.kind)) {
            throw `The task ${node.name} is of the kind ${node.kind}, which this job type does not know.`;
        }
        const type = node.kind === "train" && settings.gpu ? "fdda-gpu" : TYPES[node.kind];
        const task = authorTask(settings, node.name, type, ["--task", node.name]);
        for (const before of node.after) {
            if (!Object.hasOwn(made, before)) {
                throw `The task ${node.name} waits for ${before}, which is not before it.`;
            }
            task.addDependency(made[before]);
        }
        made[node.name] = task;
        if (node.kind === "bind") {
            bound.push(task);
        }
        job.addTask(task);
    }
    const report = authorTask(settings, "report", "misc", ["--report-only"]);
    for (const task of bound) {
        report.addDependency(task);
    }
    job.addTask(report);
}

function authorTask(settings, name, type, options) {
    const task = author.Task(name, type);
    // `exec` sets no environment: the launcher finds the project by its own place.
    const launcher = settings.project + "/farm/launch.py";
    task.addCommand(author.Command("exec", { exe: settings.python, args: [launcher, settings.plan].concat(options) }));
    return task;
}
