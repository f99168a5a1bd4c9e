// SPDX-License-Identifier: GPL-3.0-or-later
// A job type of Flamenco: a job that makes one character of a plan on one worker (docs/farm.md).
const JOB_TYPE = {
    label: "FDDA character",
    settings: [
        { key: "character", type: "string", required: true, description: "Name of the character in the plan" },
        { key: "plan", type: "string", subtype: "file_path", required: true, description: "characters.yaml" },
        { key: "project", type: "string", subtype: "dir_path", required: true, description: "Folder of FDDA for Blender" },
        { key: "cores", type: "int32", default: 1, description: "Number of verbs that run at the same time" },
    ],
};

function compileJob(job) {
    const { character, plan, project, cores } = job.settings;
    const args = [`--snakefile=${project}/farm/Snakefile`, `--configfile=${plan}`, `--cores=${cores}`, character];
    const task = author.Task(character, "blender");
    task.addCommand(author.Command("exec", { exe: `${project}/.venv-farm/bin/snakemake`, args: args }));
    job.addTask(task);
}
