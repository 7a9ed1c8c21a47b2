// What the report's page takes of three.js; three.min.js is made from this file, see NOTICE.
export {
  AxesHelper, BufferAttribute, BufferGeometry, Line, LineBasicMaterial, PerspectiveCamera, Points,
  PointsMaterial, Scene, Vector3, WebGLRenderer,
} from 'three';
export { OrbitControls } from 'three/examples/jsm/controls/OrbitControls.js';
