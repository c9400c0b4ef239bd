// A line's or a point's quad, placed by the page.
in vec4 a_place;   // pixels, depth, unused
in vec4 a_color;
in vec2 a_corner;  // of a point's square, -1 to 1; a line has y = 0
uniform vec2 u_size;
out vec4 v_color;
out vec2 v_corner;
flat out float v_depth;

void main() {
  v_color = a_color;
  v_corner = a_corner;
  v_depth = a_place.z;
  gl_Position = vec4(2.0 * a_place.x / u_size.x - 1.0, 1.0 - 2.0 * a_place.y / u_size.y, 0.0, 1.0);
}
