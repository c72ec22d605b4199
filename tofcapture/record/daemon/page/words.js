// What the page says: of each state its word, what the arm does, and what to press. The words are those on the buttons.
export const STEPS = { moving: "moving the arm", tof: "ToF burst", stereo: "stereo frame", sealing: "writing" };
export const RED_BUTTON = "press the red button on the teach pendant";

const FAULTS = { ProtectiveStop: "protective stop", EmergencyStop: "emergency stop", SafetyStop: "safety stop", DiskFull: "disk full" };

const STATES = {
  lost: () => ["connection lost", "", "The arm may still move, and this page cannot stop it.", `If it must stop, ${RED_BUTTON}. Trying again.`],
  silent: (s) => ["no sign of life", "", `The recorder has been silent for ${s.health.silence_s} s. The arm may still move.`,
    `Press Stop. If the arm does not stop, ${RED_BUTTON}.`],
  fault: (s) => [FAULTS[s.fault] ?? "fault", s.reason.replace(/[;,]? then start again\.?$/, ""), "The arm rests.", "Lift the cause, then press Resume."],
  stopped: (s) => ["stopped", rest(s.reason, "stopped"), "The arm rests. Sealed views stay.",
    "Press Resume to go on with the queue, Retry in the history to take up the job again."],
  paused: (s) => ["paused", rest(s.reason, "paused"), "The arm rests.", "Press Resume to go on."],
  pausing: (s) => ["pausing", rest(s.reason, "paused"), `The view in hand is finished first${view(s)}.`, "Press Resume to go on instead."],
  stopping: () => ["stopping", "", "The arm is told to stop.", `If it does not, ${RED_BUTTON}.`],
  waiting: (s) => ["waiting for a person", "", `The arm rests. Put ${s.asks} on the table and step out of the arm's reach.`, "Then press It is placed."],
  recording: (s) => ["recording", "", does(s), "Press Pause to rest after this view, Stop to stop the arm now."],
  idle: () => ["idle", "", "The arm rests, the queue is empty.", "Press Add to the queue to record a scene."],
};

const rest = (reason, word) => (reason.startsWith(word) ? reason.slice(word.length).trim() : reason);
const view = ({ doing }) => (doing ? `: view ${doing.index}, ${STEPS[doing.step] ?? doing.step}` : "");

function does(s) {
  if (!s.doing) return s.progress.total ? "The arm may move at any moment." : "The station is opened and the views are planned; then the arm moves.";
  if (s.doing.step === "moving") return `The arm moves to view ${s.doing.index}.`;
  return `The arm stands still at view ${s.doing.index}: ${STEPS[s.doing.step] ?? s.doing.step}.`;
}

// The key of a state, and its four texts: word, why, what the arm does, what to press.
export function tell(state, lost) {
  let key = state?.phase ?? "idle";
  if (key === "paused" && state.fault) key = "fault";
  else if (key === "paused" && state.reason.startsWith("stopped")) key = "stopped";
  else if (key === "recording" && state.asks) key = "waiting";
  if (state?.health.recorder === "silent") key = "silent";
  if (lost) key = "lost";
  return [key, ...STATES[key](state)];
}

export const ALARMS = new Set(["lost", "silent", "fault"]);

export const named = (job) => `${job.scene} into ${job.recording}${job.retake == null ? "" : `, view ${job.retake} again`}`;

export const EVENTS = {
  queued: (d) => `queued: job ${d.job.id}, ${named(d.job)}`,
  cancelled: (d) => `removed: job ${d.job.id}, ${named(d.job)}`,
  moved: (d) => `job ${d.job.id}, ${named(d.job)}, is number ${d.place} of those that wait`,
  opened: () => "the station is open",
  planned: (d) => [`${d.views.length} views planned, ${d.wanted} wanted`, ...d.repaired].join("; "),
  sealed: (d) => [`view ${d.index} sealed`, ...(d.quality?.notes ?? [])].join("; "),
  failed: (d) => `view ${d.index} failed: ${d.reason}`,
  ask: (d) => `waiting for a person to place ${d.scene}`,
  answered: (d) => `${d.scene} is placed`,
  paused: () => "paused: the recorder rests",
  resumed: () => "resumed: the recorder goes on",
  log: (d) => d.text,
  state: (d) => tell({ ...d.state, health: {} }, false).slice(1, 3).join(" "),
};
