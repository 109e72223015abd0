"use strict";
// What pages share: numbers as text, a canvas, colours, the drawing of the fraction. Names that a page takes: `common`.
const common = (() => {
const percent = x => x === null ? "\u2013" : (100 * x).toFixed(0) + " %";
function scale(from, to, low, high) { const k = (high - low) / ((to - from) || 1); return x => low + (x - from) * k; }
function labelColour(label) { return { coal: "--coal", gangue: "--gangue" }[label] || "--other"; }
const $ = id => document.getElementById(id);
const colour = name => getComputedStyle(document.documentElement).getPropertyValue(name).trim();
function make(parent, tag, kind) {
  const made = document.createElement(tag);
  made.className = kind || "";
  parent.append(made);
  return made;
}
function canvas(element) {
  const ratio = devicePixelRatio || 1, box = element.getBoundingClientRect();
  element.width = box.width * ratio; element.height = box.height * ratio;
  const context = element.getContext("2d");
  context.scale(ratio, ratio);
  context.font = "11px system-ui, sans-serif";
  return [context, box.width, box.height];
}
function drawShare(element, shares, threshold, turns) {
  const [c, width, height] = canvas(element), left = 42, known = shares.filter(one => one[1] !== null), marks = [];
  const y = scale(0, 1, height - 18, 6), soft = colour("--soft");
  c.fillStyle = soft;
  for (const level of [0, .5, 1]) { c.fillText(percent(level), 0, y(level) + 4); c.fillRect(left, y(level), width - left, .5); }
  if (threshold !== null) {
    c.fillStyle = colour("--shut"); c.fillRect(left, y(threshold), width - left, 1);
    marks.push([`limit ${percent(threshold)}`, left + 4, y(threshold) - 4, "--shut", "left"]);
  }
  if (!known.length) return;
  const x = scale(known[0][0], known[known.length - 1][0], left, width - 4);
  c.globalAlpha = .25; c.fillStyle = colour("--gangue"); c.beginPath();
  for (const one of known) c.lineTo(x(one[0]), y(one[3]));
  for (const one of known.slice().reverse()) c.lineTo(x(one[0]), y(one[2]));
  c.fill(); c.globalAlpha = 1;
  c.strokeStyle = colour("--gangue"); c.lineWidth = 2; c.beginPath();
  for (const one of known) c.lineTo(x(one[0]), y(one[1]));
  c.stroke();
  turns.forEach(([time, kind], k) => {
    if (time < known[0][0]) return;
    const [side, gap] = x(time) > width / 2 ? ["right", -5] : ["left", 5];
    const [word, name] = kind === "shut" ? ["SHUT", "--shut"] : ["GO ON", "--draw"];
    c.fillStyle = colour(name); c.fillRect(x(time) - 1, y(1), 2, y(0) - y(1));
    marks.push([`${word} ${time.toFixed(0)} s`, x(time) + gap, y(1) + 12 + 14 * (k % 2), name, side]);
  });
  c.strokeStyle = colour("--card"); c.lineWidth = 3; c.lineJoin = "round";
  for (const [text, left, top, name, side] of marks) {  // with a rim, to be legible on lines
    c.textAlign = side; c.fillStyle = colour(name);
    c.strokeText(text, left, top); c.fillText(text, left, top);
  }
  c.textAlign = "left"; c.fillStyle = soft; c.fillText(`${known[0][0].toFixed(0)} s`, left, height - 4);
  c.textAlign = "right"; c.fillText(`${known[known.length - 1][0].toFixed(0)} s`, width, height - 4);
}
return { percent, scale, labelColour, $, colour, make, canvas, drawShare };
})();
