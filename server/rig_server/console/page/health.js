// Every camera's health as a table of small plots, and the rig's as larger ones.

import { draw } from "./plot.js";
import { byId, clock, element, number } from "./words.js";

const MOST = 600; // samples
// How a quantity is told: digits, the factor, the unit, from where on it is a trouble.
export const TOLD = {
  fps: { title: "frames/s", digits: 1, least: 0, most: 30 },
  loss: { title: "lost", digits: 2, factor: 100, unit: " %", least: 0, most: 0.05, high: 0.01 },
  damaged: { title: "damaged/s", digits: 1, least: 0, most: 1, high: 0.5 },
  temperature_c: { title: "temperature", digits: 0, unit: " °C", high: 80 },
  clock_error_us: { title: "clock", digits: 0, unit: " µs", least: 0, high: 500 },
  drift_mm: { title: "moved", digits: 1, unit: " mm", least: 0, most: 5 },
  drift_deg: { title: "turned", digits: 2, unit: " °", least: 0, most: 0.5 },
  sets_per_s: { title: "sets a second", digits: 1, least: 0, most: 30 },
  spread_ms: { title: "spread of a set", digits: 1, unit: " ms", least: 0 },
  record_mb_s: { title: "recorded", digits: 1, unit: " MB/s", least: 0 },
};

export class Health {
  #series = new Map(); // quantity -> camera id or "rig" -> values
  #drawn_ms = 0;
  #sampled_ms = 0;

  async load() {
    const response = await fetch("/history");
    if (!response.ok) return;
    const { series } = await response.json();
    this.#series.clear();
    for (const [quantity, places] of Object.entries(series)) {
      this.#series.set(quantity, new Map(Object.entries(places)));
    }
    this.#drawn_ms = 0;
  }

  show(state) {
    const now = performance.now();
    if (now - this.#sampled_ms >= 950) {
      this.#sampled_ms = now;
      this.#add(state.health);
    }
    if (now - this.#drawn_ms < 950) return;
    this.#drawn_ms = now;
    byId("health-told").textContent = `last ${clock(this.values("sets_per_s", "rig").length)}`;
    this.#plots(state);
    this.#table(state);
  }

  #add(health) {
    for (const [quantity, places] of Object.entries(health)) {
      if (!this.#series.has(quantity)) this.#series.set(quantity, new Map());
      const held = this.#series.get(quantity);
      for (const [place, value] of Object.entries(places)) {
        if (!held.has(place)) held.set(place, []);
        const values = held.get(place);
        values.push(value);
        if (values.length > MOST) values.shift();
      }
    }
  }

  values(quantity, place) {
    return this.#series.get(quantity)?.get(String(place)) ?? [];
  }

  #known(quantity) {
    const places = [...(this.#series.get(quantity)?.values() ?? [])];
    return places.some((values) => values.some((value) => value !== null));
  }

  #plots(state) {
    const shown = ["sets_per_s", "spread_ms", "record_mb_s"];
    const box = byId("rig-plots");
    if (!box.children.length) {
      for (const quantity of shown) {
        const figure = element("figure", "", "plot");
        const caption = element("figcaption");
        caption.append(element("span", TOLD[quantity].title), element("b"));
        figure.append(caption, element("canvas"));
        box.append(figure);
      }
    }
    shown.forEach((quantity, k) => {
      const figure = box.children[k];
      figure.hidden = !this.#known(quantity);
      if (figure.hidden) return;
      figure.querySelector("b").textContent = told(quantity, state.health[quantity]?.rig);
      draw(figure.querySelector("canvas"), this.values(quantity, "rig"), TOLD[quantity]);
    });
  }

  #table(state) {
    const quantities = Object.keys(TOLD).filter((name) => {
      return state.health[name] && !("rig" in state.health[name]) && this.#known(name);
    });
    const table = byId("health-table");
    const key = quantities.join() + state.cameras.map((camera) => camera.name).join();
    if (table.dataset.key !== key) {
      table.dataset.key = key;
      rebuild(table, quantities, state.cameras);
    }
    state.cameras.forEach((camera, row) => {
      const line = table.tBodies[0].rows[row];
      line.classList.toggle("gone", !camera.connected);
      quantities.forEach((quantity, column) => {
        const cell = line.cells[column + 1];
        const value = state.health[quantity][camera.id];
        cell.querySelector("span").textContent = told(quantity, value);
        const high = (value ?? 0) >= (TOLD[quantity].high ?? Infinity);
        cell.classList.toggle("high", high);
        const options = { ...TOLD[quantity], color: high ? "--bad" : "--accent" };
        draw(cell.querySelector("canvas"), this.values(quantity, camera.id), options);
      });
    });
  }
}

function rebuild(table, quantities, cameras) {
  const head = element("tr");
  for (const title of ["camera", ...quantities.map((name) => TOLD[name].title)]) {
    const cell = element("th", title);
    cell.scope = "col";
    head.append(cell);
  }
  table.tHead.replaceChildren(head);
  table.tBodies[0].replaceChildren(
    ...cameras.map((camera) => {
      const row = element("tr");
      row.append(element("td", camera.name));
      for (let k = 0; k < quantities.length; k++) {
        const cell = element("td");
        const inside = element("div", "", "cell");
        inside.append(element("span"), element("canvas"));
        cell.append(inside);
        row.append(cell);
      }
      return row;
    }),
  );
}

export function told(quantity, value) {
  if (value === null || value === undefined) return "–";
  const { digits, factor = 1, unit = "" } = TOLD[quantity];
  return number(value * factor, digits) + unit;
}
