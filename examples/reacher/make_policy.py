"""Writes policy.onnx: the arm's inverse kinematics and a proportional controller, in ONNX's own operations.

    python examples/reacher/make_policy.py

Nothing is learned: the angles at which an arm of two links (0.10 m and 0.11 m) touches a place have a closed form.
"""

from pathlib import Path

import onnx.checker
import onnx.parser

POLICY = """
<ir_version: 10, opset_import: ["" : 18]>
reacher (float[batch, 10] observation) => (float[batch, 2] action)
<float one = {1.0}, float squares = {0.0221}, float twice_product = {0.022}, float upper = {0.10}, float lower = {0.11},
 float straight = {1.0}, float folded = {-0.99}, float tiny = {0.000001}, float almost_one = {1.01}, float gain = {8.0},
 float fastest = {2.0}, float backwards = {-2.0}>
{
  cos_1, cos_2, sin_1, sin_2, speed_1, speed_2, x, y, tip_x, tip_y = Split <axis = 1, num_outputs = 10> (observation)
  xx = Mul(x, x)  yy = Mul(y, y)  rr = Add(xx, yy)
  over = Sub(rr, squares)  bent = Div(over, twice_product)
  cos_elbow = Clip(bent, folded, straight)
  cos_squared = Mul(cos_elbow, cos_elbow)  sin_squared = Sub(one, cos_squared)  sin_elbow = Sqrt(sin_squared)
  along_lower = Mul(lower, cos_elbow)  along = Add(upper, along_lower)  across = Mul(lower, sin_elbow)
  x_along = Mul(x, along)  y_across = Mul(y, across)  y_along = Mul(y, along)  x_across = Mul(x, across)
  cos_raw = Add(x_along, y_across)  sin_raw = Sub(y_along, x_across)  rr_safe = Max(rr, tiny)
  cos_shoulder = Div(cos_raw, rr_safe)  sin_shoulder = Div(sin_raw, rr_safe)
  a = Mul(sin_shoulder, cos_1)  b = Mul(cos_shoulder, sin_1)  c = Mul(cos_shoulder, cos_1)  d = Mul(sin_shoulder, sin_1)
  sin_error_1 = Sub(a, b)  cos_error_1 = Add(c, d)
  e = Mul(sin_elbow, cos_2)  f = Mul(cos_elbow, sin_2)  g = Mul(cos_elbow, cos_2)  h = Mul(sin_elbow, sin_2)
  sin_error_2 = Sub(e, f)  cos_error_2 = Add(g, h)
  sines = Concat <axis = 1> (sin_error_1, sin_error_2)  cosines = Concat <axis = 1> (cos_error_1, cos_error_2)
  below = Add(almost_one, cosines)  half = Div(sines, below)  wanted = Mul(gain, half)
  action = Clip(wanted, backwards, fastest)
}
"""

if __name__ == "__main__":
    model = onnx.parser.parse_model(POLICY)
    onnx.checker.check_model(model, full_check=True)
    Path(__file__).with_name("policy.onnx").write_bytes(model.SerializeToString(deterministic=True))
