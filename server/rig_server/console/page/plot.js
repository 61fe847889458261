// A line over time: as many points as pixels, gaps where nothing is known.

export function draw(canvas, values, { least = null, most = null, color = "--accent", fill = true } = {}) {
  const scale = window.devicePixelRatio || 1;
  const [width, height] = [canvas.clientWidth, canvas.clientHeight];
  if (!width || !height) return;
  canvas.width = Math.round(width * scale);
  canvas.height = Math.round(height * scale);
  const known = values.filter((value) => value !== null && value !== undefined);
  if (!known.length) return;
  const low = least ?? Math.min(...known);
  const high = Math.max(most ?? -Infinity, ...known);
  const span = high - low || Math.abs(high) || 1;
  const x = (k) => (values.length > 1 ? k / (values.length - 1) : 1) * (width - 2) + 1;
  const y = (value) => height - 2 - ((value - low) / span) * (height - 4);
  const context = canvas.getContext("2d");
  const ink = getComputedStyle(canvas).getPropertyValue(color);
  context.scale(scale, scale);
  context.strokeStyle = context.fillStyle = ink;
  context.lineWidth = 1.25;
  context.lineJoin = "round";
  for (const [first, last] of stretches(values)) {
    context.beginPath();
    for (let k = first; k <= last; k++) context.lineTo(x(k), y(values[k]));
    if (first === last) context.lineTo(x(first) + 1, y(values[first]));
    context.stroke();
    if (!fill) continue;
    context.lineTo(x(last), height);
    context.lineTo(x(first), height);
    context.globalAlpha = 0.12;
    context.fill();
    context.globalAlpha = 1;
  }
}

function stretches(values) {
  const found = [];
  values.forEach((value, k) => {
    if (value === null || value === undefined) return;
    if (found.length && found.at(-1)[1] === k - 1) found.at(-1)[1] = k;
    else found.push([k, k]);
  });
  return found;
}
