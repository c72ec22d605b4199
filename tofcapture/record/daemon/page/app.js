// The page: one event stream in, a few verbs out. Text goes in as textContent only.
import { drawPlan } from "./picture.js";

const $ = (id) => document.getElementById(id);
const LOG_LINES = 200;
const STEPS = { moving: "moving the arm", tof: "ToF burst", stereo: "stereo frame", sealing: "writing" };

// The token comes once in the fragment, which no server sees, and is not left in the address bar.
const given = new URLSearchParams(location.hash.slice(1)).get("token");
if (given) {
  sessionStorage.setItem("token", given);
  history.replaceState(null, "", location.pathname);
}
const token = sessionStorage.getItem("token") ?? "";

let state = null;
let views = new Map();
let shown = 0; // number of the preview on show
let lastEvent = null;

async function call(method, path, body) {
  const headers = { Authorization: `Bearer ${token}` };
  if (method !== "GET") Object.assign(headers, { "X-Tofcapture": "1", "Content-Type": "application/json" });
  const answer = await fetch(path, { method, headers, body: body && JSON.stringify(body), cache: "no-store" });
  if (!answer.ok) {
    const { error } = await answer.json().catch(() => ({ error: { message: answer.statusText, hint: "" } }));
    throw Object.assign(new Error([error.message, error.hint].filter(Boolean).join(" - ")), { status: answer.status });
  }
  return answer;
}

function notice(text) {
  $("notice").textContent = text;
  $("notice").hidden = !text;
}

async function verb(path, body = {}) {
  try {
    notice("");
    return await (await call("POST", path, body)).json();
  } catch (error) {
    notice(error.message);
    return null;
  }
}

function sure(text) {
  const dialog = $("sure");
  $("sure-text").textContent = text;
  dialog.returnValue = "no";
  dialog.showModal();
  return new Promise((done) => {
    dialog.addEventListener("close", () => done(dialog.returnValue === "yes"), { once: true });
  });
}

function showState() {
  const { phase, reason, job, progress, doing, asks } = state;
  $("phase").textContent = reason && phase !== "recording" ? `${phase}: ${reason}` : phase;
  document.title = `${phase} ${progress.total ? `${progress.sealed}/${progress.total} ` : ""}- tofcapture`;
  $("pause").disabled = !["recording", "idle"].includes(phase);
  $("resume").disabled = !["paused", "pausing"].includes(phase);
  $("ask").hidden = !asks;
  if (asks) $("ask").firstElementChild.textContent = `Put ${asks} on the table, step out of the arm's reach.`;
  if (job) $("job").textContent = `${job.scene} into ${job.recording}: ${job.state}${job.reason ? ` (${job.reason})` : ""}`;
  $("motion").textContent = state.simulated ? "Simulated station." : state.allow_motion ? "A real arm may move." : "A real arm may not move.";
  showProgress(progress, doing);
  showHealth(state.health);
}

function showProgress(progress, doing) {
  $("bar").max = Math.max(progress.total, 1);
  $("bar").value = progress.sealed;
  const left = progress.eta_s ? `, about ${Math.ceil(progress.eta_s / 60)} min left` : "";
  const failed = progress.failed ? `, ${progress.failed} failed` : "";
  const step = doing ? ` - view ${doing.index}: ${STEPS[doing.step] ?? doing.step}` : "";
  $("doing").textContent = progress.total ? `${progress.sealed} of ${progress.total} views${failed}${left}${step}` : "";
}

function showHealth(health) {
  const free = health.disk_free_bytes === null ? "?" : (health.disk_free_bytes / 1e9).toFixed(1);
  $("health").textContent = `Recorder ${health.recorder}, ${free} GB free, ${health.restarts} restarts.`;
}

const percent = (x) => (x === undefined ? "" : `${(100 * x).toFixed(1)} %`);

function showViews() {
  const now = state?.doing?.index;
  const rows = [...views.values()].map((view) => {
    const q = view.quality ?? {};
    const motion = q.motion_m === undefined ? "" : `${(1000 * q.motion_m).toFixed(2)} mm`;
    const word = view.index === now ? (STEPS[state.doing.step] ?? state.doing.step) : view.state;
    const row = document.createElement("tr");
    const cells = [view.index, word, percent(q.saturated), percent(q.dark), percent(q.stereo_coverage), motion, q.frame_drops ?? ""];
    row.append(...cells.map((text) => Object.assign(document.createElement("td"), { textContent: text })));
    row.children[1].className = view.index === now ? "now" : view.state;
    const said = view.reason || (q.notes ?? []).join("; ");
    if (said) row.title = said;
    return row;
  });
  $("views").replaceChildren(...rows);
  drawPlan($("plan"), views.values(), now);
}

async function showJobs() {
  const { jobs } = await (await call("GET", "v1/jobs")).json();
  const lines = jobs.slice(0, 12).map((job) => {
    const line = Object.assign(document.createElement("li"), { textContent: `${job.id}: ${job.scene} into ${job.recording}: ${job.state} ` });
    if (job.state === "queued") {
      const button = Object.assign(document.createElement("button"), { textContent: "Cancel", type: "button" });
      button.setAttribute("aria-label", `Cancel job ${job.id}`);
      button.addEventListener("click", () => verb(`v1/jobs/${job.id}/cancel`));
      line.append(button);
    }
    return line;
  });
  $("jobs").replaceChildren(...lines);
}

async function showPictures(number) {
  if (!number || number === shown) return;
  shown = number;
  await Promise.all(["amplitude", "depth", "stereo"].map(async (name) => {
    const image = $(name);
    const answer = await call("GET", `v1/preview/${name}`).catch(() => null);
    if (!answer) return;
    const old = image.src;
    image.src = URL.createObjectURL(await answer.blob());
    image.hidden = false;
    image.dataset.number = number;
    if (old) URL.revokeObjectURL(old);
  }));
}

function log(utc, text) {
  const line = document.createElement("li");
  const time = Object.assign(document.createElement("time"), { dateTime: utc, textContent: utc.slice(11, 19) });
  line.append(time, ` ${text}`);
  $("log").prepend(line);
  while ($("log").children.length > LOG_LINES) $("log").lastElementChild.remove();
}

const TEXT = {
  queued: (d) => `queued: ${d.job.scene} into ${d.job.recording}`,
  cancelled: (d) => `cancelled: job ${d.job.id}`,
  opened: () => "the station is open",
  planned: (d) => [`${d.views.length} views planned, ${d.wanted} wanted`, ...d.repaired].join("; "),
  sealed: (d) => `view ${d.index} sealed`,
  failed: (d) => `view ${d.index} failed: ${d.reason}`,
  ask: (d) => `waiting for a person to place ${d.scene}`,
  answered: (d) => `${d.scene} is placed`,
  paused: () => "the recorder rests",
  resumed: () => "the recorder goes on",
  log: (d) => d.text,
  state: (d) => `${d.state.phase}${d.state.reason ? `: ${d.state.reason}` : ""}`,
};

function happened(kind, data) {
  if (kind === "health") {
    if (state) state.health = data;
    return showHealth(data);
  }
  if (TEXT[kind]) log(data.utc, TEXT[kind](data));
  if (kind === "queued" || kind === "cancelled") return showJobs();
  if (kind === "state") {
    if (data.state.job?.id !== state?.job?.id) views = new Map();
    state = data.state;
    showJobs();
  }
  if (!state) return undefined;
  if (data.progress) state.progress = data.progress;
  if (kind === "planned") views = new Map(data.views.map((v) => [v.index, { ...views.get(v.index), ...v }]));
  if (kind === "step" && data.step !== "failed") state.doing = { index: data.index, step: data.step };
  if (kind === "ask") state.asks = data.scene;
  if (kind === "answered") state.asks = null;
  if (kind === "opened") state.simulated = data.simulated;
  if (kind === "paused") Object.assign(state, { phase: "paused", doing: null });
  if (kind === "resumed") Object.assign(state, { phase: "recording", reason: "" });
  if (kind === "sealed" || kind === "failed") {
    views.set(data.index, { ...views.get(data.index), index: data.index, state: kind, quality: data.quality, reason: data.reason });
    state.doing = null;
    showPictures(data.preview);
  }
  showState();
  return showViews();
}

async function refresh() {
  state = await (await call("GET", "v1/state")).json();
  lastEvent = state.last_event;
  const table = await (await call("GET", "v1/views")).json();
  views = new Map(table.views.map((view) => [view.index, view]));
  showState();
  showViews();
  await Promise.all([showJobs(), showPictures(state.preview)]);
}

// fetch instead of EventSource: only fetch can show the token.
async function follow() {
  const answer = await call("GET", `v1/events?after=${lastEvent}`);
  const reader = answer.body.pipeThrough(new TextDecoderStream()).getReader();
  let rest = "";
  for (;;) {
    const { done, value } = await reader.read();
    if (done) return;
    const blocks = (rest + value).split("\n\n");
    rest = blocks.pop();
    for (const block of blocks) {
      const field = (name) => block.split("\n").find((line) => line.startsWith(`${name}: `))?.slice(name.length + 2);
      if (field("id")) lastEvent = Number(field("id"));
      if (field("data")) happened(field("event"), JSON.parse(field("data")));
    }
  }
}

async function live() {
  for (;;) {
    try {
      await refresh();
      notice("");
      await follow();
    } catch (error) {
      if (error.status === 401) {
        $("phase").textContent = "no access";
        notice("This page needs the daemon's token: open the address that tofcapture status --url prints.");
        return;
      }
    }
    $("phase").textContent = "connection lost, trying again";
    await new Promise((done) => setTimeout(done, 1000));
  }
}

$("pause").addEventListener("click", () => verb("v1/pause"));
$("resume").addEventListener("click", async () => {
  const real = state && !state.simulated && state.allow_motion;
  if (!real || (await sure("A real arm will move. Is everybody out of its reach?"))) verb("v1/resume");
});
$("stop").addEventListener("click", async () => {
  if (await sure("Stop the arm now and give this job up? Sealed views stay.")) verb("v1/stop");
});
$("confirm").addEventListener("click", () => verb("v1/confirm"));
$("sure-yes").addEventListener("click", () => $("sure").close("yes"));
$("sure-no").addEventListener("click", () => $("sure").close("no"));
$("new").addEventListener("submit", async (event) => {
  event.preventDefault();
  const form = new FormData(event.target);
  const wish = { scene: form.get("scene"), recording: form.get("recording"), request_id: crypto.randomUUID() };
  await verb("v1/jobs", { ...wish, views: Number(form.get("views")), frames: Number(form.get("frames")) });
});
live();
