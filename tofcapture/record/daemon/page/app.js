// The page: one event stream in, a few verbs out. Text goes in as textContent only.
import { drawPlan, drawScale } from "./picture.js";
import { ALARMS, EVENTS, RED_BUTTON, STEPS, named, tell } from "./words.js";

const $ = (id) => document.getElementById(id);
const make = (tag, more = {}) => Object.assign(document.createElement(tag), more);
const LOG_LINES = 500;
const PATIENCE = 5000; // ms for an answer
const SILENCE = 7000; // ms without an event until the connection counts as lost; health comes every 2 s

// The token comes once in the fragment, which no server sees, and is not left in the address bar.
const given = new URLSearchParams(location.hash.slice(1)).get("token");
if (given) {
  sessionStorage.setItem("token", given);
  history.replaceState(null, "", location.pathname);
}
const token = sessionStorage.getItem("token") ?? "";

let state = null;
let lost = false;
let views = new Map();
let shown = 0; // number of the preview on show
let lastEvent = null;
let announced = "";

async function call(method, path, body, signal = AbortSignal.timeout(PATIENCE)) {
  const headers = { Authorization: `Bearer ${token}` };
  if (method !== "GET") Object.assign(headers, { "X-Tofcapture": "1", "Content-Type": "application/json" });
  const answer = await fetch(path, { method, headers, body: body && JSON.stringify(body), cache: "no-store", signal });
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
    notice(error.status ? error.message : `The daemon did not hear it: ${error.message}.`);
    return null;
  }
}

// What makes a real arm move: first a person says that nobody is in its reach.
async function move(what, path, body = {}) {
  if (!state) return;
  if (!state.real) await verb(path, body);
  else if (await sure(`A real arm will move: ${what}. Is everybody out of its reach?`)) await verb(path, { ...body, clear: true });
}

function sure(text) {
  const dialog = $("sure");
  if (dialog.open) return Promise.resolve(false);
  $("sure-text").textContent = text;
  dialog.returnValue = "no";
  dialog.showModal();
  return new Promise((done) => {
    dialog.addEventListener("close", () => done(dialog.returnValue === "yes"), { once: true });
  });
}

async function stop() {
  notice("");
  try {
    await call("POST", "v1/stop", {});
  } catch (error) {
    notice(`STOP WAS NOT HEARD: ${RED_BUTTON}. (${error.message})`);
  }
}

// Children of a list by key: those that stay are not made anew, so that neither focus nor a click in progress is lost.
function sync(list, items, key, begin, fill) {
  const known = new Map([...list.children].map((node) => [node.dataset.key, node]));
  const focused = document.activeElement;
  items.forEach((item, place) => {
    const name = String(key(item));
    const node = known.get(name) ?? begin(item);
    node.dataset.key = name;
    known.delete(name);
    fill(node, item, place);
    if (list.children[place] !== node) list.insertBefore(node, list.children[place] ?? null);
  });
  for (const node of known.values()) node.remove();
  if (focused?.isConnected && focused !== document.activeElement) focused.focus();
}

function set(node, text) {
  if (node.textContent !== String(text)) node.textContent = text;
}

function showState() {
  const [key, word, why, does, press] = tell(state, lost);
  $("band").dataset.state = key;
  for (const [id, text] of Object.entries({ word, why, does, press })) set($(id), text);
  const said = [word, why, ALARMS.has(key) ? `${does} ${press}` : ""].join(" ");
  if (said !== announced) {
    announced = said;
    set($(ALARMS.has(key) ? "alarm" : "said"), said);
    set($(ALARMS.has(key) ? "said" : "alarm"), "");
  }
  const { phase, job, progress, doing, asks } = state ?? { phase: "", progress: { total: 0 } };
  document.title = `${lost ? word.toUpperCase() : word} ${progress.total ? `${progress.sealed}/${progress.total} ` : ""}- tofcapture`;
  $("pause").disabled = lost || !["recording", "waiting", "idle"].includes(phase);
  $("resume").disabled = lost || !["paused", "pausing"].includes(phase);
  $("confirm").hidden = lost || !asks;
  if (!state) return;
  if (job) set($("job"), `${named(job)}: ${job.state}${job.reason ? ` (${job.reason})` : ""}`);
  $("job").className = job?.state === "failed" ? "failed" : "";
  set($("motion"), state.simulated ? "Simulated station." : state.allow_motion ? "A real arm may move." : "A real arm may not move.");
  showProgress(progress, doing);
  const { disk_free_bytes: free, recorder, restarts } = state.health;
  set($("health"), `Recorder ${recorder}, ${free === null ? "?" : (free / 1e9).toFixed(1)} GB free, ${restarts} restarts.`);
}

function showProgress(progress, doing) {
  $("bar").max = Math.max(progress.total, 1);
  $("bar").value = progress.sealed;
  const left = progress.eta_s ? `, about ${Math.ceil(progress.eta_s / 60)} min left` : "";
  const failed = progress.failed ? `, ${progress.failed} failed` : "";
  const step = doing ? ` - view ${doing.index}: ${STEPS[doing.step] ?? doing.step}` : "";
  set($("doing"), progress.total ? `${progress.sealed} of ${progress.total} views${failed}${left}${step}` : "");
}

const percent = (x) => (x === undefined ? "" : `${(100 * x).toFixed(1)} %`);
const COLUMNS = [...document.querySelectorAll("thead th")].map((head) => head.textContent);

function beginView(view) {
  const row = make("tr");
  row.append(...COLUMNS.map((name) => {
    const cell = make("td");
    cell.dataset.name = name;
    return cell;
  }));
  const button = make("button", { textContent: "Retake", type: "button" });
  button.setAttribute("aria-label", `Retake view ${view.index}`);
  button.addEventListener("click", () => {
    const { scene, recording, views: count, frames, seed } = state.job;
    const wish = { scene, recording, views: count, frames, retake: view.index, request_id: crypto.randomUUID() };
    move(`view ${view.index} of ${scene} is taken again`, "v1/jobs", seed === null ? wish : { ...wish, seed });
  });
  row.lastElementChild.append(button);
  return row;
}

function fillView(row, view) {
  const q = view.quality ?? {};
  const now = view.index === state?.doing?.index;
  const motion = q.motion_m === undefined ? "" : `${(1000 * q.motion_m).toFixed(2)} mm`;
  const word = now ? (STEPS[state.doing.step] ?? state.doing.step) : view.state;
  const notes = [view.reason, ...(q.notes ?? [])].filter(Boolean).join("; ");
  const texts = [view.index, word, percent(q.saturated), percent(q.dark), percent(q.stereo_coverage), motion, q.frame_drops ?? "", notes];
  texts.forEach((text, n) => set(row.children[n], text));
  row.children[1].className = now ? "now" : view.state;
  row.lastElementChild.firstElementChild.hidden = !["sealed", "failed"].includes(view.state) || now;
}

function showViews() {
  sync($("views"), [...views.values()].sort((a, b) => a.index - b.index), (view) => view.index, beginView, fillView);
  drawPlan($("plan"), views.values(), state?.doing?.index);
}

function jobButton(job, word, act) {
  const button = make("button", { textContent: word, type: "button" });
  button.setAttribute("aria-label", `${word}: job ${job.id}, ${named(job)}`);
  button.addEventListener("click", act);
  return button;
}

async function showJobs() {
  const { jobs } = await (await call("GET", "v1/jobs")).json();
  const waiting = jobs.filter((job) => job.state === "queued");
  const ahead = jobs.filter((job) => ["queued", "running"].includes(job.state));
  const place = (job) => [...$("queue").querySelectorAll(".queued")].findIndex((line) => line.dataset.key === `${job.id}queued`) + 1;
  const begin = (job) => {
    const line = make("li", { className: job.state });
    line.append(make("span"));
    const at = (by) => verb(`v1/jobs/${job.id}/move`, { place: Math.max(1, place(job) + by) });
    if (job.state === "queued") {
      line.append(jobButton(job, "Earlier", () => at(-1)), jobButton(job, "Later", () => at(1)));
      line.append(jobButton(job, "Remove", () => verb(`v1/jobs/${job.id}/cancel`)));
    } else if (job.state !== "running") {
      line.append(jobButton(job, "Retry", () => move(`${named(job)} is recorded`, `v1/jobs/${job.id}/retry`)));
    }
    return line;
  };
  const fill = (line, job, n) => {
    const text = `${named(job)}, ${job.views} views of ${job.frames} frames`;
    if (job.state === "running") return set(line.firstElementChild, `running: ${text}`);
    if (job.state !== "queued") return set(line.firstElementChild, `${clock(job.changed_utc)} ${named(job)}: ${job.state}${job.reason ? ` - ${job.reason}` : ""}`);
    const nth = n - (ahead.length - waiting.length);
    line.children[1].disabled = nth === 0;
    line.children[2].disabled = nth === waiting.length - 1;
    return set(line.firstElementChild, `${nth ? `${nth + 1}.` : "next:"} ${text}`);
  };
  sync($("queue"), ahead, (job) => job.id + job.state, begin, fill);
  sync($("history"), jobs.filter((job) => !ahead.includes(job)), (job) => job.id + job.state, begin, fill);
  $("empty").hidden = ahead.length > 0;
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
    drawScale(image.nextElementSibling, state.scales?.[name]);
    if (old) URL.revokeObjectURL(old);
  }));
}

function clock(utc) {
  const time = new Date(utc);
  const today = time.toDateString() === new Date().toDateString();
  return `${today ? "" : `${time.toLocaleDateString()} `}${time.toTimeString().slice(0, 8)}`;
}

function line(kind, data) {
  const node = make("li", { className: kind });
  node.append(make("time", { dateTime: data.utc, textContent: clock(data.utc) }), ` ${EVENTS[kind](data)}`);
  return node;
}

function log(kind, data) {
  $("log").prepend(line(kind, data));
  while ($("log").children.length > LOG_LINES) $("log").lastElementChild.remove();
}

const sameScene = (a, b) => a?.scene === b?.scene && a?.recording === b?.recording;

function happened(kind, data) {
  if (!state) return;
  if (EVENTS[kind]) log(kind, data);
  if (kind === "health") state.health = data;
  if (["queued", "cancelled", "moved", "state"].includes(kind)) showJobs().catch(() => null);
  if (kind === "state") {
    if (!sameScene(data.state.job, state.job)) views = new Map();
    state = data.state;
  }
  if (data.progress) state.progress = data.progress;
  if (kind === "planned") views = new Map(data.views.map((v) => [v.index, { ...views.get(v.index), reason: "", ...v }]));
  if (kind === "step" && data.step !== "failed") state.doing = { index: data.index, step: data.step };
  if (kind === "ask") state.asks = data.scene;
  if (kind === "answered") Object.assign(state, { asks: null, phase: state.phase === "waiting" ? "recording" : state.phase });
  if (kind === "opened") Object.assign(state, { simulated: data.simulated, real: state.allow_motion && !data.simulated });
  if (kind === "paused") Object.assign(state, { phase: "paused", doing: null });
  if (kind === "resumed") Object.assign(state, { phase: "recording", reason: "" });
  if (kind === "sealed" || kind === "failed") {
    views.set(data.index, { ...views.get(data.index), index: data.index, state: kind, quality: data.quality, reason: data.reason });
    Object.assign(state, { doing: null, scales: data.scales ?? state.scales });
    showPictures(data.preview);
  }
  showState();
  if (kind !== "health") showViews();
}

async function refresh() {
  state = await (await call("GET", "v1/state")).json();
  lastEvent = state.last_event;
  const [table, past] = await Promise.all(["v1/views", "v1/log"].map(async (path) => (await call("GET", path)).json()));
  views = new Map(table.views.map((view) => [view.index, view]));
  const old = past.events.filter((e) => e.id <= lastEvent && EVENTS[e.event]);
  $("log").replaceChildren(...old.reverse().map((e) => line(e.event, e)));
  await showJobs();
  lost = false;
  showState();
  showViews();
  shown = 0;
  await showPictures(state.preview);
}

// fetch instead of EventSource: only fetch can show the token.
async function follow() {
  const line = new AbortController();
  let silence = setTimeout(() => line.abort(), SILENCE);
  const answer = await call("GET", `v1/events?after=${lastEvent}`, undefined, line.signal);
  const reader = answer.body.pipeThrough(new TextDecoderStream()).getReader();
  let rest = "";
  for (;;) {
    const { done, value } = await reader.read();
    if (done) return;
    clearTimeout(silence);
    silence = setTimeout(() => line.abort(), SILENCE);
    const blocks = (rest + value).split("\n\n");
    rest = blocks.pop();
    for (const block of blocks) {
      const field = (name) => block.split("\n").find((text) => text.startsWith(`${name}: `))?.slice(name.length + 2);
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
        set($("word"), "no access");
        notice("This page needs the daemon's token: open the address that tofcapture status --url prints.");
        return;
      }
    }
    lost = true;
    showState();
    await new Promise((done) => setTimeout(done, 1000));
  }
}

$("pause").addEventListener("click", () => verb("v1/pause"));
$("resume").addEventListener("click", () => move("the queue goes on", "v1/resume"));
$("stop").addEventListener("click", stop);
$("confirm").addEventListener("click", () => move(`${state.asks} is placed and is recorded`, "v1/confirm"));
$("sure-yes").addEventListener("click", () => $("sure").close("yes"));
$("sure-no").addEventListener("click", () => $("sure").close("no"));
$("sure-stop").addEventListener("click", () => {
  $("sure").close("no");
  stop();
});
$("new").addEventListener("submit", async (event) => {
  event.preventDefault();
  const form = new FormData(event.target);
  const wish = { scene: form.get("scene"), recording: form.get("recording"), request_id: crypto.randomUUID() };
  await move(`${wish.scene} is recorded`, "v1/jobs", { ...wish, views: Number(form.get("views")), frames: Number(form.get("frames")) });
});
live();
