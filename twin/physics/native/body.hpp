// One soft body: nodes around an origin of its own, in single precision.
#pragma once

#include <cstdint>
#include <vector>

#include "geometry.hpp"
#include "tets.hpp"

namespace soft {

struct Sample {
    std::int32_t ids[2];  // a surface node twice, or both ends of a surface edge
};

struct Contact {
    std::int32_t sample;
    std::int32_t collider;
    bool holds = false;        // it touched in the last substep
    std::int32_t face = -1;    // of the piece, through which the sample came in
    Float3 facing{0, 0, 0};    // outward normal of the body's surface there, base frame
    Float3 anchor{0, 0, 0};    // where friction holds it, in the piece's frame
};

struct Pair {
    std::int32_t sample;       // of this body
    std::int32_t other;        // another body
    std::int32_t ids[3];       // nodes of one of its triangles
    float weights[3];          // nearest point of the triangle
};

struct Box {
    Double3 low, high;
};

struct BodySpec {
    std::vector<Double3> nodes;           // where they are now
    std::vector<Double3> rest;            // at rest, any frame
    std::vector<std::int32_t> tets;
    std::vector<double> masses;           // [kg]
    std::vector<Sample> samples;
    std::vector<std::int32_t> triangles;
    double young, poisson, damping_s, damping_rate, friction, spacing;
};

class Body {
  public:
    explicit Body(const BodySpec& spec);

    double longest_substep(double step_s) const;  // that keeps its stiffness; a guess is given
    void build_blocks(double step_s);

    // x, y, z and the inverse mass of each node; four that never move come last, for empty lanes.
    std::vector<float> p;
    std::vector<float> start;   // of the substep
    std::vector<float> v;       // fourth number unused
    Double3 origin;
    std::vector<TetBlock> blocks;
    std::vector<std::int32_t> order;
    Material material;
    std::vector<Sample> samples;
    std::vector<std::int32_t> triangles;
    std::vector<Float3> normals;  // of the surface, by node, of no particular length
    double friction, damping_s, damping_rate, spacing;
    int num_nodes;
    bool lost = false;          // its nodes are no numbers any more

    bool touches = false;       // anything, in this substep
    Float3 support{0, 0, 0};    // mass times shift by still pieces, in this substep
    std::vector<Contact> contacts;
    std::vector<Contact> past_contacts;  // of the last step, in the same order
    std::vector<Pair> pairs;
    std::vector<std::uint8_t> touched;  // by collider, in the last step
    Box box;                            // around all nodes, base frame
    double top_speed;

    Float3 at(std::int32_t id) const { return {p[4 * id], p[4 * id + 1], p[4 * id + 2]}; }
    Float3 started(std::int32_t id) const {
        return {start[4 * id], start[4 * id + 1], start[4 * id + 2]};
    }
    float inverse_mass(std::int32_t id) const { return p[4 * id + 3]; }
    void shift(std::int32_t id, const Float3& by) {
        p[4 * id] += by.x;
        p[4 * id + 1] += by.y;
        p[4 * id + 2] += by.z;
    }
    Float3 sample_at(const Sample& s) const { return (at(s.ids[0]) + at(s.ids[1])) * 0.5f; }
    Float3 sample_started(const Sample& s) const {
        return (started(s.ids[0]) + started(s.ids[1])) * 0.5f;
    }
    Float3 sample_facing(const Sample& s) const;  // length 1, or 0 where the surface has none
    // What a force on a sample accelerates it by, and how a shift of the sample moves its nodes.
    float sample_inverse_mass(const Sample& s) const {
        return s.ids[0] == s.ids[1] ? inverse_mass(s.ids[0])
                                    : 0.25f * (inverse_mass(s.ids[0]) + inverse_mass(s.ids[1]));
    }
    void shift_sample(const Sample& s, const Float3& by, float sample_inverse_mass);

    void look_around();                       // box, speed, origin, normals
    void predict(double gravity, float step_s, const Kernels& kernels);
    void relax(const Kernels& kernels) {
        kernels.relax(blocks.data(), static_cast<int>(blocks.size()), p.data(), start.data(),
                      material);
    }
    void finish(float step_s);
    void damp(float step_s);                  // what is not rigid motion gets slower

  private:
    struct Tet {
        Matrix b, system;
        double step_volume, coupling;
    };

    BodySpec spec_;
    std::vector<float> predicted_, masses_;
    double mass_ = 0.0;

    Tet tet_of(std::int32_t t, double step_s) const;
    void update_normals();
    void recentre(const Double3& middle);
};

}  // namespace soft
