// The pile in three dimensions: the slider says before which load.
"use strict";
(() => {
  const scene = JSON.parse(document.getElementById("scene").textContent);
  const nx = scene.x.length, ny = scene.y.length, count = scene.loads.length;
  const place = document.getElementById("pile"), slider = document.getElementById("load");
  const said = document.getElementById("said"), play = document.getElementById("play");

  // Whole numbers of two bytes, low byte first.
  function unpacked(text) {
    const bytes = Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
    const view = new DataView(bytes.buffer);
    return Array.from({ length: bytes.length / 2 }, (_, k) => view.getInt16(2 * k, true));
  }

  const first = unpacked(scene.heights), floor = unpacked(scene.floor);
  const changes = scene.changes.map((change) => ({ ...change, heights: unpacked(change.heights) }));
  let now = Float64Array.from(first), made = 0;

  function make(loads) {
    if (loads < made) { now = Float64Array.from(first); made = 0; }
    for (; made < loads; made++) {
      const { at, size, heights } = changes[made];
      for (let i = 0; i < size[0]; i++)
        for (let j = 0; j < size[1]; j++)
          now[(at[0] + i) * ny + at[1] + j] = heights[i * size[1] + j];
    }
  }

  // Rows of y, as the surface wants them.
  function rows(value) {
    return scene.y.map((_, j) => scene.x.map((_, i) => value(i * ny + j)));
  }
  const height = () => rows((k) => scene.lowest + scene.step * now[k]);
  const soil = () => rows((k) => scene.step * (now[k] - floor[k]));
  const deepest = first.reduce((most, value, k) => Math.max(most, value - floor[k]), 1);

  function line(points, gear) {
    const shown = gear === null ? points : points.map((p) => (p[3] === gear ? p : [null, null, null]));
    return { x: shown.map((p) => p[0]), y: shown.map((p) => p[1]), z: shown.map((p) => p[2]) };
  }

  function box({ corners, ground, height }, colour, name) {
    const x = [], y = [], z = [];
    for (const up of [ground, ground + height])
      for (const [a, b] of corners) { x.push(a); y.push(b); z.push(up); }
    const side = [0, 1, 2, 3].flatMap((k) => [[k, (k + 1) % 4, k + 4], [(k + 1) % 4, (k + 1) % 4 + 4, k + 4]]);
    const faces = [...side, [4, 5, 6], [4, 6, 7]];
    return { type: "mesh3d", x, y, z, i: faces.map((f) => f[0]), j: faces.map((f) => f[1]),
      k: faces.map((f) => f[2]), color: colour, flatshading: true, hoverinfo: "name", name };
  }

  // Axes say the coordinates of the scan.
  function axis(low, high, offset, title) {
    const step = [1, 2, 5, 10, 20, 50, 100].find((s) => (high - low) / s <= 7) || 200;
    const ticks = [];
    for (let v = Math.ceil((low + offset) / step) * step; v - offset <= high; v += step)
      ticks.push(v);
    return { title: { text: title }, tickvals: ticks.map((v) => v - offset),
      ticktext: ticks.map((v) => v.toFixed(0)), range: [low, high], showspikes: false };
  }

  const still = { showlegend: false, hoverinfo: "skip", type: "scatter3d", mode: "lines" };
  const traces = [
    { type: "surface", x: scene.x, y: scene.y, z: height(), surfacecolor: soil(), cmin: 0,
      cmax: scene.step * deepest, showscale: false, name: "",
      colorscale: [[0, "#c9ced4"], [0.03, "#cbbd9d"], [1, "#8a5a22"]],
      contours: { x: { highlight: false }, y: { highlight: false }, z: { highlight: false } },
      lighting: { ambient: 0.55, diffuse: 0.8, specular: 0.05, roughness: 0.9 },
      hovertemplate: "height %{z:.2f} m<extra></extra>" },
    { ...still, name: "reverse", line: { color: "#1d2733", width: 4, dash: "dash" }, x: [], y: [], z: [] },
    { ...still, name: "forward", line: { color: "#1d2733", width: 5 }, x: [], y: [], z: [] },
    { ...still, name: "approach and dig", line: { color: "#1f5fa8", width: 10 }, x: [], y: [], z: [] },
    ...scene.trucks.map((truck, k) => box(truck, "#3a7d44", scene.trucks.length > 1 ? `truck ${k + 1}` : "truck")),
  ];
  const [low, high] = scene.view;
  function eye() {
    const across = scene.side.map((v, k) => v - 0.5 * (low[k] + high[k]));
    // A little to the side of where the trucks stand.
    const angle = Math.atan2(across[1], across[0]) + 0.9;
    return { x: 1.6 * Math.cos(angle), y: 1.6 * Math.sin(angle), z: 1.1 };
  }
  const layout = {
    margin: { l: 0, r: 0, t: 0, b: 0 }, paper_bgcolor: "rgba(0,0,0,0)", uirevision: "kept", showlegend: false,
    scene: { aspectmode: "data", camera: { eye: eye(), center: { x: 0, y: 0, z: -0.15 } },
      xaxis: axis(low[0], high[0], scene.offset[0], "x, east [m]"),
      yaxis: axis(low[1], high[1], scene.offset[1], "y, north [m]"),
      zaxis: { title: { text: "" }, showspikes: false } },
  };
  const config = { responsive: true, displaylogo: false, displayModeBar: false, scrollZoom: false };

  function words(n) {
    if (n === count) return `after all ${count} loads`;
    return `before load ${n + 1} of ${count}: ` + scene.said[n];
  }

  function show(n) {
    make(n);
    const next = scene.loads[n];
    const reverse = next ? line(next.path, -1) : line([], -1), ahead = next ? line(next.path, 1) : line([], 1);
    const dig = next ? line(next.dig, null) : line([], null);
    traces[0] = { ...traces[0], z: height(), surfacecolor: soil() };
    [reverse, ahead, dig].forEach((points, k) => { traces[1 + k] = { ...traces[1 + k], ...points }; });
    scene.trucks.forEach((_, k) => {
      const here = !next || next.truck === k;
      traces[4 + k] = { ...traces[4 + k], opacity: here ? 1 : 0.25 };
    });
    said.textContent = words(n);
    slider.setAttribute("aria-valuetext", words(n));
    return Plotly.react(place, traces, layout, config);
  }

  let timer = null;
  function stop() { clearInterval(timer); timer = null; play.textContent = "Play"; }
  play.addEventListener("click", () => {
    if (timer !== null) { stop(); return; }
    if (Number(slider.value) === count) slider.value = 0;
    play.textContent = "Pause";
    timer = setInterval(() => {
      slider.value = Number(slider.value) + 1;
      show(Number(slider.value));
      if (Number(slider.value) === count) stop();
    }, Math.max(250, Math.min(900, 12000 / count)));
  });
  slider.addEventListener("input", () => { stop(); show(Number(slider.value)); });
  addEventListener("beforeprint", () => document.querySelectorAll("details").forEach((one) => { one.open = true; }));
  show(0).then(() => { place.dataset.ready = "yes"; });
})();
