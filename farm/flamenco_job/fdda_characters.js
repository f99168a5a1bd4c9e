// SPDX-License-Identifier: GPL-3.0-or-later
//
// A job type for Flamenco that records, trains and binds the characters of a plan of FDDA for Blender. Copy this file into
// the folder `scripts` beside flamenco-manager; docs/farm.md describes how to submit a job.
//
// `python -m fdda_addon farm characters.toml --flamenco job.json` writes the job with its graph of tasks. Tasks that run
// Blender have the type "blender", trainings "misc", or "fdda-gpu" where the plan needs a GPU.

const JOB_TYPE = {
    label: "FDDA characters",
    settings: [
        { key: "plan", type: "string", subtype: "file_path", required: true, visible: "web",
          description: "characters.toml, in a folder that all workers can read" },
        { key: "python", type: "string", required: true, visible: "web",
          description: "Python of the workers that has the packages of the project" },
        { key: "project", type: "string", subtype: "dir_path", required: true, visible: "web",
          description: "The folder of FDDA for Blender on the workers" },
        { key: "gpu", type: "bool", default: false, visible: "web",
          description: "Run trainings only on workers with the task type fdda-gpu" },
        { key: "graph", type: "string", required: true, visible: "hidden",
          description: "The tasks, as farm --flamenco writes them" },
    ]
};

const TASK_TYPES = {
    influences: "blender", record: "blender", merge: "file-management", train: "misc",
    evaluate: "blender", refine: "blender", bind: "blender",
};

function compileJob(job) {
    const settings = job.settings;
    const graph = JSON.parse(settings.graph);
    if (!Array.isArray(graph) || graph.length === 0) {
        throw "The setting graph has no tasks; write the job with farm --flamenco.";
    }
    const tasksByName = {};
    const bindTasks = [];
    for (const node of graph) {
        if (!Object.hasOwn(TASK_TYPES, node.kind)) {
            throw `The task ${node.name} is of the kind ${node.kind}, which this job type does not know.`;
        }
        const type = node.kind === "train" && settings.gpu ? "fdda-gpu" : TASK_TYPES[node.kind];
        const task = authorTask(settings, node.name, type, ["--task", node.name]);
        for (const dependency of node.after) {
            if (!Object.hasOwn(tasksByName, dependency)) {
                throw `The task ${node.name} waits for ${dependency}, which is not before it.`;
            }
            task.addDependency(tasksByName[dependency]);
        }
        tasksByName[node.name] = task;
        if (node.kind === "bind") {
            bindTasks.push(task);
        }
        job.addTask(task);
    }
    const report = authorTask(settings, "report", "misc", ["--report-only"]);
    for (const task of bindTasks) {
        report.addDependency(task);
    }
    job.addTask(report);
}

function authorTask(settings, name, type, options) {
    const task = author.Task(name, type);
    // Flamenco's `exec` sets no environment variables, so a script starts the farm, which finds the project by its path.
    const launcher = settings.project + "/farm/launch.py";
    task.addCommand(author.Command("exec", { exe: settings.python, args: [launcher, settings.plan].concat(options) }));
    return task;
}
