// The calibration's drawer: begin, watch the coach, accept or reject.

import { onPress, order } from "./orders.js";
import { byId, element, list, number } from "./words.js";

const PLENTY = 100; // matches: more hardly make an overlap better
const LEAD = {
  idle: "It takes complete sets while the rig goes on, and finds where every camera is.",
  waiting: "Waiting for the cameras.",
  collecting: "Collecting complete sets. Where an overlap lacks support, hang a pattern now.",
  solving: "Finding where the cameras are.",
  ready: "Done. It is not in force yet.",
  failed: "It did not work out.",
};

export class Calibration {
  #phase = null;

  constructor() {
    onPress("calibrate", () => {
      const camera = byId("calibrate-camera").value || null;
      return order("start-calibration", { coached: byId("coached").checked, camera });
    });
    onPress("cancel", () => order("cancel-calibration"));
    onPress("accept", () => order("accept-calibration"));
    onPress("reject", () => order("reject-calibration"));
    byId("open-calibration").addEventListener("click", () => this.toggle());
    byId("cloud-calibrate").addEventListener("click", () => this.toggle(true));
    byId("calibration").querySelector(".close").addEventListener("click", () => this.toggle(false));
  }

  get open() {
    return !byId("calibration").hidden;
  }

  toggle(open = !this.open) {
    byId("calibration").hidden = !open;
    byId("open-calibration").setAttribute("aria-expanded", String(open));
    document.body.classList.toggle("calibrating", open);
    if (open) byId("calibrate").focus({ preventScroll: true });
  }

  show(state) {
    const session = state.session;
    if (session.phase !== this.#phase && (session.phase === "ready" || session.phase === "failed")) {
      this.toggle(true);
    }
    this.#phase = session.phase;
    const message = session.message ?? LEAD[session.phase];
    byId("calibration-lead").textContent = state.orders
      ? message
      : "The command line has this rig calibrated; one can look on here.";
    byId("calibration-start").hidden = session.busy || session.phase === "ready" || !state.orders;
    byId("calibration-progress").hidden = !session.busy;
    byId("calibration-decision").hidden = session.phase !== "ready" || !state.orders;
    byId("accept").hidden = session.failures.length > 0;
    byId("cancel").hidden = !state.orders;
    byId("sets").value = session.wanted ? session.sets / session.wanted : 0;
    byId("sets-told").textContent = `${session.sets} of ${session.wanted}`;
    byId("share").value = session.share;
    byId("stage-told").textContent = session.stage || "solving";
    byId("calibration-headline").textContent = session.headline ?? "";
    list("calibration-failures", session.failures);
    const advice = session.pairs.filter((pair) => pair.advice).map((pair) => `${pair.name}: ${pair.advice}`);
    list("advice", session.missed ? [...advice, `target: ${session.missed}`] : advice);
    showPairs(session.pairs);
    showMoved(session, state.cameras);
    offerCameras(state);
  }
}

function showPairs(pairs) {
  byId("pairs").hidden = pairs.length === 0;
  const rows = pairs.map((pair) => {
    const row = element("tr");
    const bar = element("span", "", "matches");
    bar.style.width = `${(Math.min(pair.matches, PLENTY) / PLENTY) * 44}px`;
    const matches = element("td", "", `${pair.support}-support`);
    matches.append(bar, String(pair.matches));
    const support = element("td", pair.support, `${pair.support}-support`);
    row.append(element("td", pair.name), matches, element("td", number(pair.deg, 3)));
    row.append(element("td", number(pair.mm, 1)), support);
    return row;
  });
  byId("pairs").tBodies[0].replaceChildren(...rows);
}

function showMoved(session, cameras) {
  const moved = Object.entries(session.moved);
  byId("moved").hidden = moved.length === 0;
  const names = new Map(cameras.map((camera) => [String(camera.id), camera.name]));
  const rows = moved.map(([id, [deg, mm]]) => {
    const row = element("tr");
    row.append(element("td", names.get(id) ?? id), element("td", number(deg, 2)), element("td", number(mm, 1)));
    return row;
  });
  byId("moved").tBodies[0].replaceChildren(...rows);
}

function offerCameras(state) {
  const select = byId("calibrate-camera");
  const names = state.calibration ? state.cameras.map((camera) => camera.name) : [];
  const key = names.join();
  if (select.dataset.key === key) return;
  select.dataset.key = key;
  const all = element("option", "all");
  all.value = "";
  select.replaceChildren(all, ...names.map((name) => element("option", `only ${name}`)));
  [...select.options].slice(1).forEach((option, k) => (option.value = names[k]));
}
