// The parts of three.js that the report uses; bundled into three.min.js (see README.md here).
export {
  BufferAttribute,
  BufferGeometry,
  PerspectiveCamera,
  Points,
  Quaternion,
  Scene,
  ShaderMaterial,
  Vector3,
  Matrix4,
  WebGLRenderer,
} from "three";
export { OrbitControls } from "three/examples/jsm/controls/OrbitControls.js";
