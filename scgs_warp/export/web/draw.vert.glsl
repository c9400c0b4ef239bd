// A Gaussian's ellipse as two triangles, farthest first. Not as instances: drivers are slow with many of four vertices.
uniform usampler2D u_place, u_color;
uniform usampler2D u_order;
uniform vec2 u_size;
out vec2 v_corner;
flat out vec4 v_color;  // rgb, or with DEPTH depth 0 0; opacity

void main() {
  int index = int(texelFetch(u_order, at(gl_VertexID / 6), 0).x), which = gl_VertexID % 6;
  if (which > 2) which -= 2;
  uvec4 place = texelFetch(u_place, at(index), 0), color = texelFetch(u_color, at(index), 0);
  float opacity = uintBitsToFloat(color.z);
  if (opacity == 0.0) {  // culled: outside of everything
    gl_Position = vec4(2.0, 2.0, 2.0, 1.0);
    return;
  }
  vec2 corner = vec2(which & 1, which >> 1) * 2.0 - 1.0;
  vec2 pixel = uintBitsToFloat(place.xy) + corner.x * unpackHalf2x16(place.z) + corner.y * unpackHalf2x16(place.w);
  v_corner = corner * sqrt(extent_of(opacity));
#ifdef DEPTH
  v_color = vec4(uintBitsToFloat(color.w), 0.0, 0.0, opacity);
#else
  v_color = vec4(unpackHalf2x16(color.x), unpackHalf2x16(color.y).x, opacity);
#endif
  gl_Position = vec4(2.0 * pixel.x / u_size.x - 1.0, 1.0 - 2.0 * pixel.y / u_size.y, 0.0, 1.0);
}
