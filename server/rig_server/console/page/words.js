// Numbers and times for people.

export function number(value, digits = 1) {
  return value === null || value === undefined ? "–" : value.toFixed(digits);
}

export function clock(seconds) {
  const whole = Math.floor(seconds);
  const [hours, minutes] = [Math.floor(whole / 3600), Math.floor(whole / 60) % 60];
  const rest = String(whole % 60).padStart(2, "0");
  return hours ? `${hours}:${String(minutes).padStart(2, "0")}:${rest}` : `${minutes}:${rest}`;
}

export function awaySince(seconds) {
  if (seconds === null || seconds === undefined) return "no frame yet";
  const since = new Date(Date.now() - 1000 * seconds).toLocaleTimeString();
  return `no frames since ${since}`;
}

export function element(name, text = "", className = "") {
  const made = document.createElement(name);
  if (text !== "") made.textContent = text;
  if (className) made.className = className;
  return made;
}

export const byId = (id) => document.getElementById(id);

export function list(id, lines) {
  byId(id).replaceChildren(...lines.map((line) => element("li", line)));
}
