'use strict';

// Player: the pictures of the strip, one after the other.
(() => {
  const thumbs = [...document.querySelectorAll('#strip img')];
  if (!thumbs.length) return;
  const images = JSON.parse(document.getElementById('frames').textContent);
  const image = document.getElementById('player-image');
  const depth = document.getElementById('player-depth');
  const [play, seek, when] = ['play', 'seek', 'when'].map((id) => document.getElementById(id));
  let timer = 0;

  function show(index) {
    thumbs.forEach((thumb, k) => thumb.classList.toggle('shown', k === index));
    depth.src = thumbs[index].src;
    if (image && images[index]) image.src = images[index];
    seek.value = index;
    when.textContent = `${thumbs[index].dataset.seconds} s`;
  }
  function stop() {
    clearInterval(timer);
    timer = 0;
    play.textContent = 'Play';
  }
  play.addEventListener('click', () => {
    if (timer) { stop(); return; }
    play.textContent = 'Stop';
    timer = setInterval(() => show((Number(seek.value) + 1) % thumbs.length), 160);
  });
  seek.addEventListener('input', () => { stop(); show(Number(seek.value)); });
  thumbs.forEach((thumb, k) => thumb.addEventListener('click', () => { stop(); show(k); }));
  show(0);
  if (thumbs.length > 1 && !matchMedia('(prefers-reduced-motion: reduce)').matches) play.click();
})();

// Cloud.
(() => {
  const holder = document.getElementById('scene');
  if (!holder) return;
  const data = JSON.parse(holder.textContent);
  const canvas = document.getElementById('view');
  let renderer;
  try {
    renderer = new THREE.WebGLRenderer({ canvas, antialias: true, preserveDrawingBuffer: true });
  } catch (error) {
    document.getElementById('no-view').hidden = false;
    canvas.hidden = true;
    return;
  }

  function bytes(text) {
    return Uint8Array.from(atob(text), (character) => character.charCodeAt(0));
  }
  const steps = new Uint16Array(bytes(data.positions).buffer);
  const positions = new Float32Array(steps.length);
  // About the middle, so that a cloud far from the origin keeps its precision.
  const extent = [0, 0, 0];
  for (let i = 0; i < steps.length; i++) extent[i % 3] = Math.max(extent[i % 3], steps[i]);
  const middle = extent.map((steps) => steps * data.step / 2);
  for (let i = 0; i < steps.length; i++) positions[i] = steps[i] * data.step - middle[i % 3];
  const local = (p) => p.map((value, axis) => value - data.origin[axis] - middle[axis]);

  const turbo = [[48, 18, 59], [71, 119, 239], [40, 188, 235], [49, 242, 153], [162, 252, 60],
                 [237, 208, 58], [251, 128, 34], [210, 49, 5], [122, 4, 3]];
  function colourOf(level, out, at) {
    const place = Math.min(Math.max(level, 0), 1) * (turbo.length - 1);
    const low = Math.min(Math.floor(place), turbo.length - 2);
    for (let k = 0; k < 3; k++) {
      out[at + k] = turbo[low][k] + (place - low) * (turbo[low + 1][k] - turbo[low][k]);
    }
  }
  const painters = {
    picture: () => bytes(data.colours),
    height: () => {
      const heights = Float32Array.from({ length: data.count }, (_, i) => positions[3 * i + 2]);
      const sorted = heights.slice().sort();
      const low = sorted[Math.floor(0.02 * (data.count - 1))];
      const high = Math.max(sorted[Math.floor(0.98 * (data.count - 1))], low + 0.1);
      const out = new Uint8Array(3 * data.count);
      heights.forEach((z, i) => colourOf((z - low) / (high - low), out, 3 * i));
      return out;
    },
    sigma: () => {  // code 1 … 255 is 1 mm … 10 m; shown from 1 cm to 1 m; grey is unknown
      const out = new Uint8Array(3 * data.count).fill(110);
      bytes(data.sigma).forEach((code, i) => {
        if (code) colourOf(((code - 1) / 254 * 4 - 1) / 2, out, 3 * i);
      });
      return out;
    },
  };

  renderer.setClearColor(0x10151a);
  const scene = new THREE.Scene();
  const geometry = new THREE.BufferGeometry();
  geometry.setAttribute('position', new THREE.BufferAttribute(positions, 3));
  const material = new THREE.PointsMaterial({ size: 3, sizeAttenuation: false, vertexColors: true });
  material.onBeforeCompile = (shader) => {  // colours are what the screen shows
    shader.fragmentShader = shader.fragmentShader.replace('#include <colorspace_fragment>', '');
  };
  scene.add(new THREE.Points(geometry, material));
  data.tracks.forEach((track, index) => {
    const line = new THREE.BufferGeometry().setFromPoints(
      track.positions.map((p) => new THREE.Vector3(...local(p))));
    scene.add(new THREE.Line(line, new THREE.LineBasicMaterial(
      { color: [0xffffff, 0xff9f1c, 0x2ec4b6, 0xe05fd0][index % 4] })));
  });
  const start = data.tracks.length ? data.tracks[0].positions[0] : [0, 0, 0];
  const axes = new THREE.AxesHelper(1);
  axes.position.set(...local(start));
  scene.add(axes);

  const camera = new THREE.PerspectiveCamera(60, 1, 0.05, 5000);
  camera.up.set(0, 0, 1);
  const controls = new THREE.OrbitControls(camera, canvas);
  const end = data.tracks.length ? data.tracks[0].positions.at(-1) : [5, 0, 0];

  function draw() {
    const { clientWidth: width, clientHeight: height } = canvas;
    if (!width || !height) return;
    renderer.setPixelRatio(Math.min(devicePixelRatio, 2));
    renderer.setSize(width, height, false);
    camera.aspect = width / height;
    camera.updateProjectionMatrix();
    renderer.render(scene, camera);
    canvas.dataset.points = renderer.info.render.points;
  }
  function paint(name) {
    geometry.setAttribute('color', new THREE.BufferAttribute(painters[name](), 3, true));
    draw();
  }
  function look(from, to) {
    camera.position.set(...local(from));
    controls.target.set(...local(to));
    controls.update();
    draw();
  }
  function fromBehind() {
    const ahead = [end[0] - start[0], end[1] - start[1]];
    const length = Math.hypot(...ahead);
    const [x, y] = length > 0.1 ? ahead.map((value) => value / length) : [1, 0];
    look([start[0] - 8 * x, start[1] - 8 * y, start[2] + 5],
         [start[0] + 6 * x, start[1] + 6 * y, start[2]]);
  }
  function fromAbove() {
    const centre = start.map((value, axis) => (value + end[axis]) / 2);
    const far = 30 + 0.6 * Math.hypot(end[0] - start[0], end[1] - start[1]);
    // Not exactly: the way up would be unknown.
    look([centre[0] - 0.01, centre[1], centre[2] + far], centre);
  }

  const colour = document.getElementById('colour');
  const size = document.getElementById('size');
  colour.addEventListener('change', () => paint(colour.value));
  size.addEventListener('input', () => { material.size = Number(size.value); draw(); });
  document.getElementById('from-start').addEventListener('click', fromBehind);
  document.getElementById('from-above').addEventListener('click', fromAbove);
  controls.addEventListener('change', draw);
  new ResizeObserver(draw).observe(canvas);
  paint(colour.value);
  fromBehind();
})();
