// A ROS 2 node around the exported controller: written for rclcpp, compiled only where
// ROS 2 is. It takes std_msgs/msg/Float64MultiArray on "measured" (p numbers: the
// state, or with a filter what sensors show), on "reference" (n numbers, a set point),
// on "reference_input" (m, from which deviations are weighed) and on "parameters" (q),
// and publishes the same type on "input" (m), once it has heard what it needs.
// Written by gpmpc; the next export overwrites it.

#include <rclcpp/rclcpp.hpp>
#include <std_msgs/msg/float64_multi_array.hpp>

#include "gpmpc.h"

using Numbers = std_msgs::msg::Float64MultiArray;

class ControllerNode : public rclcpp::Node {
public:
    ControllerNode() : Node("@name@")
    {
        const gpmpc_real origin[GPMPC_STATES] = {};
        gpmpc_reset(&controller_);
        gpmpc_hold(&reference_, origin);
        publisher_ = create_publisher<Numbers>("input", 1);
        references_ = create_subscription<Numbers>(
            "reference", 1, [this](const Numbers &message) { read_states(message); });
        inputs_ = create_subscription<Numbers>(
            "reference_input", 1,
            [this](const Numbers &message) { read_inputs(message); });
        parameters_ = create_subscription<Numbers>(
            "parameters", 1,
            [this](const Numbers &message) { read_parameters(message); });
        measurements_ = create_subscription<Numbers>(
            "measured", 1, [this](const Numbers &message) { decide(message); });
    }

private:
    bool has_size(const Numbers &message, const char *what, int size)
    {
        if (message.data.size() == static_cast<std::size_t>(size))
            return true;
        RCLCPP_WARN(get_logger(), "%s: must be %d numbers", what, size);
        return false;
    }

    void read_states(const Numbers &message)
    {
        if (!has_size(message, "reference", GPMPC_STATES))
            return;
        for (auto &stage : reference_.states)
            for (int i = 0; i < GPMPC_STATES; i++)
                stage[i] = static_cast<gpmpc_real>(message.data[i]);
        has_states_ = true;
    }

    void read_inputs(const Numbers &message)
    {
        if (!has_size(message, "reference_input", GPMPC_INPUTS))
            return;
        for (auto &stage : reference_.inputs)
            for (int i = 0; i < GPMPC_INPUTS; i++)
                stage[i] = static_cast<gpmpc_real>(message.data[i]);
        reference_.has_inputs = 1;
    }

    void read_parameters(const Numbers &message)
    {
        if (!has_size(message, "parameters", GPMPC_PARAMETERS))
            return;
        for (auto &stage : reference_.parameters)
            for (int i = 0; i < GPMPC_PARAMETERS; i++)
                stage[i] = static_cast<gpmpc_real>(message.data[i]);
        has_parameters_ = true;
    }

    void decide(const Numbers &message)
    {
        const bool weighs_deviations = GPMPC_PENALIZED == 1;
        if (!has_states_ || !has_parameters_)
            return;
        if (weighs_deviations && !reference_.has_inputs)
            return;
        if (!has_size(message, "measured", GPMPC_MEASURED))
            return;
        gpmpc_real measured[GPMPC_MEASURED];
        gpmpc_real input[GPMPC_INPUTS];
        for (int i = 0; i < GPMPC_MEASURED; i++)
            measured[i] = static_cast<gpmpc_real>(message.data[i]);
        gpmpc_step(&controller_, measured, &reference_, input);
        Numbers decided;
        decided.data.assign(input, input + GPMPC_INPUTS);
        publisher_->publish(decided);
    }

    gpmpc_controller controller_;
    gpmpc_reference reference_;
    bool has_states_ = false;
    bool has_parameters_ = GPMPC_PARAMETERS == 0;
    rclcpp::Publisher<Numbers>::SharedPtr publisher_;
    rclcpp::Subscription<Numbers>::SharedPtr references_;
    rclcpp::Subscription<Numbers>::SharedPtr inputs_;
    rclcpp::Subscription<Numbers>::SharedPtr parameters_;
    rclcpp::Subscription<Numbers>::SharedPtr measurements_;
};

int main(int count, char **arguments)
{
    rclcpp::init(count, arguments);
    rclcpp::spin(std::make_shared<ControllerNode>());
    rclcpp::shutdown();
    return 0;
}
