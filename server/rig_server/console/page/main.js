// The console: one state that the server tells a few times a second, shown by its parts.

import { Calibration } from "./calibration.js";
import { Detail } from "./detail.js";
import { Health } from "./health.js";
import { Keys } from "./keys.js";
import { Live, nextFrame, paint, picture } from "./live.js";
import { onPress, order } from "./orders.js";
import { Tiles } from "./tiles.js";
import { byId, clock, list, number } from "./words.js";

const live = new Live();
const health = new Health();
const detail = new Detail(look, health);
const tiles = new Tiles(live, (id) => detail.open(id));
const calibration = new Calibration();
let mode = "color";
let state = null;

tiles.onFull = (id, bitmap) => detail.paint(id, bitmap);

function look() {
  live.look({ mode, enlarged: detail.id });
}

function setMode(chosen) {
  mode = chosen;
  for (const button of document.querySelectorAll("[data-mode]")) {
    button.setAttribute("aria-checked", String(button.dataset.mode === mode));
  }
  look();
}

live.addEventListener("connected", ({ detail: here }) => {
  const told = byId("connection");
  told.textContent = here ? "connected" : "connection lost, trying again …";
  told.classList.toggle("lost", !here);
  if (here) health.load();
});

live.addEventListener("state", ({ detail: told }) => {
  state = told;
  showFigures(state);
  showCloud(state);
  tiles.show(state);
  health.show(state);
  detail.show(state);
  calibration.show(state);
});

live.addEventListener("panorama", async ({ detail: message }) => {
  const bitmap = await picture(message.data, message.start, message.data.byteLength - message.start);
  await nextFrame();
  paint(byId("panorama"), bitmap);
  bitmap.close();
});

function showFigures(now) {
  byId("place").textContent = now.ended ? `${now.place}, ended` : now.place;
  byId("figure-cameras").textContent = `${now.connected}/${now.cameras.length}`;
  byId("figure-cameras").classList.toggle("bad", now.connected < now.cameras.length);
  byId("figure-sets").textContent = number(now.sets_per_s);
  byId("figure-spread").textContent = now.spread_ms === null ? "–" : `${number(now.spread_ms)} ms`;
  byId("figure-calibration").textContent = now.calibration ? calibrated(now.calibration) : "none";
  list("alarms", now.alarms);
  byId("alarms").hidden = now.alarms.length === 0;
  list("troubles", now.troubles);
  byId("figures-told").textContent = now.figures.slice(1).join(" · ");
  const { tiles: count, p50_ms, p95_ms } = now.latency;
  byId("latency").textContent = count
    ? `datagram to painted tile ${number(p50_ms, 0)} ms, 95 % within ${number(p95_ms, 0)} ms`
    : "";
  const recording = now.recording && now.recording.ended === null ? now.recording : null;
  byId("record").classList.toggle("on", recording !== null);
  byId("record").hidden = !now.orders;
  byId("record-text").textContent = recording ? `Stop ${clock(recording.seconds)}` : "Record";
}

function calibrated({ created, cameras }) {
  const when = new Date(created);
  const day = Number.isNaN(when.getTime()) ? "" : `, ${when.toLocaleDateString()}`;
  return `${cameras} cameras${day}`;
}

function showCloud(now) {
  const preview = now.session.phase === "ready";
  const known = now.calibration !== null || preview;
  const scene = byId("scene");
  byId("cloud-empty").hidden = known;
  byId("cloud-calibrate").hidden = !now.orders;
  if (known && scene.hidden) {
    const dark = matchMedia("(prefers-color-scheme: dark)").matches;
    scene.src = dark ? "/scene/?darkMode" : "/scene/";
    scene.hidden = false;
  }
  const { trouble, skipped, seconds } = now.fusion;
  const told = trouble ?? skipped[0] ?? (seconds === null ? "" : `fused in ${Math.round(1000 * seconds)} ms`);
  byId("cloud-told").textContent = known ? (preview ? `preview · ${told}` : told) : "";
  byId("strip").hidden = !known;
}

for (const button of document.querySelectorAll("[data-mode]")) {
  button.addEventListener("click", () => setMode(button.dataset.mode));
}
document.addEventListener("visibilitychange", look);
function showHelp() {
  byId("help").showModal();
  byId("help").focus();
}
byId("open-help").addEventListener("click", showHelp);

function toggleRecording() {
  return order(byId("record").classList.contains("on") ? "stop-recording" : "start-recording");
}
onPress("record", toggleRecording);

const press = (id) => byId(id).offsetParent !== null && byId(id).click();
const chosen = () => detail.id ?? tiles.focused();
const toChosen = (action, wanted = {}) => chosen() !== undefined && order(action, { camera: chosen(), ...wanted });
const on = (...keys) => (event) => keys.includes(event.key.length === 1 ? event.key.toLowerCase() : event.key);
const arrow = (columns, rows) => () => (detail.id === null ? tiles.step(columns, rows) : detail.step(columns + rows));
new Keys([
  ["0 … 9", "enlarge the camera in this slot", (event) => /^\d$/.test(event.key), (event) => {
    const id = Number(event.key);
    if (tiles.ids.includes(id)) detail.open(id);
  }],
  ["←", "camera before", on("ArrowLeft"), arrow(-1, 0)],
  ["→", "next camera", on("ArrowRight"), arrow(1, 0)],
  ["↑", "row above", on("ArrowUp"), arrow(0, -1)],
  ["↓", "row below", on("ArrowDown"), arrow(0, 1)],
  ["Enter", "enlarge the chosen camera", () => false, () => {}],
  ["Esc", "close", (event) => event.key === "Escape" && calibration.open && detail.id === null, () => calibration.toggle(false)],
  ["c", "tiles in colour", on("c"), () => setMode("color")],
  ["d", "tiles as depth", on("d"), () => setMode("depth")],
  ["o", "tiles with overlaps tinted", on("o"), () => setMode("overlap")],
  ["i", "identify the chosen camera by its lamp", on("i"), () => toChosen("identify")],
  ["e", "auto exposure of the chosen camera", on("e"), () => toChosen("expose", { auto: true })],
  ["x", "hold its exposure", on("x"), () => toChosen("expose", { auto: false })],
  ["k", "open or close the calibration", on("k"), () => calibration.toggle()],
  ["y", "accept the calibration", on("y"), () => press("accept")],
  ["n", "reject it", on("n"), () => press("reject")],
  ["r", "record, or stop", on("r"), () => press("record")],
  ["?", "this help", on("?"), () => (byId("help").open ? byId("help").close() : showHelp())],
]);

look();
live.connect();
