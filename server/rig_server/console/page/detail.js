// One camera, enlarged: its full picture, its figures, and what it can be told.

import { paint } from "./live.js";
import { TOLD, told } from "./health.js";
import { onPress, order } from "./orders.js";
import { draw } from "./plot.js";
import { isGone } from "./tiles.js";
import { awaySince, byId, element } from "./words.js";

const PLOTS = ["fps", "loss", "temperature_c", "clock_error_us", "drift_mm"];

export class Detail {
  id = null;
  #state = null;
  #changed;
  #health;
  #dialog = byId("detail");

  constructor(changed, health) {
    this.#changed = changed;
    this.#health = health;
    onPress("identify", () => order("identify", { camera: this.id }));
    onPress("expose-auto", () => order("expose", { camera: this.id, auto: true }));
    onPress("expose-fixed", () => order("expose", { camera: this.id, auto: false }));
    onPress("calibrate-one", () => order("start-calibration", { camera: String(this.id) }));
    byId("detail-before").addEventListener("click", () => this.step(-1));
    byId("detail-after").addEventListener("click", () => this.step(1));
    this.#dialog.querySelector(".close").addEventListener("click", () => this.#dialog.close());
    this.#dialog.addEventListener("click", (event) => event.target === this.#dialog && this.#dialog.close());
    this.#dialog.addEventListener("close", () => {
      this.id = null;
      this.#changed();
    });
  }

  open(id) {
    this.id = id;
    if (!this.#dialog.open) {
      this.#dialog.showModal();
      this.#dialog.focus();
    }
    this.#changed();
    if (this.#state) this.show(this.#state);
  }

  step(by) {
    const ids = this.#state?.cameras.map((camera) => camera.id) ?? [];
    const at = ids.indexOf(this.id);
    if (at >= 0) this.open(ids[(at + by + ids.length) % ids.length]);
  }

  paint(id, bitmap) {
    if (id === this.id) paint(byId("detail-canvas"), bitmap);
  }

  show(state) {
    this.#state = state;
    const camera = state.cameras.find((one) => one.id === this.id);
    if (!camera) return;
    byId("detail-title").textContent = camera.name;
    byId("detail-canvas").setAttribute("aria-label", `${camera.name}, live`);
    const gone = isGone(camera);
    byId("detail-away").hidden = !gone;
    byId("detail-away").textContent = gone ? awaySince(camera.away_s) : "";
    const facts = [["frames", String(camera.frames)], ["lost", String(camera.lost)]];
    facts.push(["damaged", String(camera.damaged)], ["resent fragments", String(camera.resent)]);
    if (camera.serial) facts.push(["serial", camera.serial]);
    if (camera.port_path) facts.push(["USB port", camera.port_path]);
    facts.push(["in the calibration", camera.placed ? "yes" : "no"]);
    if (camera.moved) facts.push(["alarm", camera.moved]);
    byId("detail-facts").replaceChildren(
      ...facts.map(([title, value]) => {
        const pair = element("div");
        pair.append(element("dt", title), element("dd", value));
        return pair;
      }),
    );
    this.#plot(state, camera.id);
    for (const id of ["identify", "expose-auto", "expose-fixed", "calibrate-one"]) {
      byId(id).hidden = !state.orders || (id === "calibrate-one" && !state.calibration);
    }
  }

  #plot(state, id) {
    const box = byId("detail-plots");
    const known = PLOTS.filter((name) => this.#health.values(name, id).some((value) => value !== null));
    if (box.dataset.key !== known.join()) {
      box.dataset.key = known.join();
      box.replaceChildren(
        ...known.map((name) => {
          const figure = element("figure", "", "plot");
          const caption = element("figcaption");
          caption.append(element("span", TOLD[name].title), element("b"));
          figure.append(caption, element("canvas"));
          return figure;
        }),
      );
    }
    known.forEach((name, k) => {
      box.children[k].querySelector("b").textContent = told(name, state.health[name]?.[id]);
      draw(box.children[k].querySelector("canvas"), this.#health.values(name, id), TOLD[name]);
    });
  }
}
