// Solids that stand in the world, and how far a point is from one.
#include <math.h>

// What a solid is: MuJoCo's numbers of these geoms (mjtGeom).
enum { SPHERE = 2, CYLINDER = 5, BOX = 6 };

// size: radius; radius and half the height; halves of the edges [m]. turn: its axes in the world, as
// columns. Written by quadrl/engines/solids.py.
typedef struct {
  double kind, size[3], position[3], turn[9];
} Solid;

// Signed distance of a point from the surface of a solid [m]; negative inside.
static double solid_distance(const Solid* s, const double point[3]) {
  double away[3], local[3], out = 0, in;
  for (int k = 0; k < 3; ++k) away[k] = point[k] - s->position[k];
  for (int k = 0; k < 3; ++k) {
    local[k] = s->turn[k] * away[0] + s->turn[3 + k] * away[1] + s->turn[6 + k] * away[2];
  }
  if (s->kind == SPHERE) {
    return sqrt(local[0] * local[0] + local[1] * local[1] + local[2] * local[2]) - s->size[0];
  }
  // Past each pair of faces, or past the mantle: positive outside.
  double past[3] = {fabs(local[0]) - s->size[0], fabs(local[1]) - s->size[1],
                    fabs(local[2]) - s->size[2]};
  if (s->kind == CYLINDER) {
    past[0] = past[1] = sqrt(local[0] * local[0] + local[1] * local[1]) - s->size[0];
    past[2] = fabs(local[2]) - s->size[1];
  }
  in = past[0];
  for (int k = 0; k < 3; ++k) {
    const int twice = s->kind == CYLINDER && k == 1;  // the mantle counts once
    if (past[k] > 0 && !twice) out += past[k] * past[k];
    if (past[k] > in) in = past[k];
  }
  return out > 0 ? sqrt(out) : in;
}
