// The pile of a plan: the slider says before which load.
(() => {
  const { ny, first, box } = pile, count = scene.loads.length;
  const slider = document.getElementById("load"), said = document.getElementById("said");
  const play = document.getElementById("play");
  const changes = scene.changes.map((change) => ({ ...change, heights: pile.unpacked(change.heights) }));
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

  const still = { showlegend: false, hoverinfo: "skip", type: "scatter3d", mode: "lines" };
  const styles = [
    { name: "reverse", line: { color: "#1d2733", width: 4, dash: "dash" } },
    { name: "forward", line: { color: "#1d2733", width: 5 } },
    { name: "approach and dig", line: { color: "#1f5fa8", width: 10 } },
  ];

  function line(points, gear, style) {
    const shown = gear === null ? points : points.map((p) => (p[3] === gear ? p : [null, null, null]));
    return { ...still, ...style, x: shown.map((p) => p[0]), y: shown.map((p) => p[1]), z: shown.map((p) => p[2]) };
  }

  // The loader as it comes: its body behind the middle, the bucket at its front.
  function loader([start, tip]) {
    const long = Math.hypot(tip[0] - start[0], tip[1] - start[1]), { length, width } = scene.loader;
    const c = (tip[0] - start[0]) / long, s = (tip[1] - start[1]) / long;
    const corners = (back, front, half) => [[back, -half], [front, -half], [front, half], [back, half]]
      .map(([a, b]) => [start[0] + c * a - s * b, start[1] + s * a + c * b]);
    const [low, half] = [start[2], 0.5 * width];
    return [
      box(corners(-0.5 * length, 0.22 * length, 0.8 * half), low + 0.5, low + 1.7, "#e0a800", "loader"),
      box(corners(-0.15 * length, 0.08 * length, 0.5 * half), low + 1.7, low + 3.1, "#4a5563", "loader"),
      box(corners(0.36 * length, 0.5 * length, half), low, low + 0.9, "#4a5563", "bucket"),
    ];
  }

  function truck({ ground, bed, cab }, name, here) {
    const faint = here ? 1 : 0.25;
    return [
      { ...box(bed, ground + 0.9, ground + 2.4, "#3a7d44", name), opacity: faint },
      { ...box(cab, ground + 0.4, ground + 3.0, "#1d2733", name), opacity: faint },
    ];
  }

  function words(n) {
    if (n === count) return `after all ${count} loads`;
    return `before load ${n + 1} of ${count}: ` + scene.said[n];
  }

  function show(n) {
    make(n);
    const next = scene.loads[n], path = next ? next.path : [], dig = next ? next.dig : [];
    said.textContent = words(n);
    slider.setAttribute("aria-valuetext", words(n));
    return pile.draw([
      pile.surface(now),
      line(path, -1, styles[0]), line(path, 1, styles[1]), line(dig, null, styles[2]),
      ...scene.trucks.flatMap((one, k) =>
        truck(one, scene.trucks.length > 1 ? `truck ${k + 1}` : "truck", !next || next.truck === k)),
      ...(next ? loader(dig) : []),
    ]);
  }

  let timer = null;
  function stop() { clearInterval(timer); timer = null; play.textContent = "Play"; }
  pile.start(() => show(Number(slider.value))).then(() => {
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
  });
})();
