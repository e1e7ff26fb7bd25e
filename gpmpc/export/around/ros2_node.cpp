// A ROS 2 node around the exported controller: written for rclcpp, compiled only where
// ROS 2 is. It takes std_msgs/msg/Float64MultiArray on "measured" (p numbers: the
// state, or with a filter what sensors show) and on "reference" (n numbers, a set
// point), and publishes the same type on "input" (m).
// Written by gpmpc; the next export overwrites it.

#include <rclcpp/rclcpp.hpp>
#include <std_msgs/msg/float64_multi_array.hpp>

#include "gpmpc.h"

using Numbers = std_msgs::msg::Float64MultiArray;

class ControllerNode : public rclcpp::Node {
public:
    ControllerNode() : Node("@name@")
    {
        gpmpc_reset(&controller_);
        publisher_ = create_publisher<Numbers>("input", 1);
        references_ = create_subscription<Numbers>(
            "reference", 1, [this](const Numbers &message) { follow(message); });
        measurements_ = create_subscription<Numbers>(
            "measured", 1, [this](const Numbers &message) { decide(message); });
    }

private:
    void follow(const Numbers &message)
    {
        if (message.data.size() != GPMPC_STATES) {
            RCLCPP_WARN(get_logger(), "a reference has %d numbers", GPMPC_STATES);
            return;
        }
        gpmpc_real state[GPMPC_STATES];
        for (int i = 0; i < GPMPC_STATES; i++)
            state[i] = static_cast<gpmpc_real>(message.data[i]);
        gpmpc_hold(&reference_, state);
        has_reference_ = true;
    }

    void decide(const Numbers &message)
    {
        if (!has_reference_)
            return;
        if (message.data.size() != GPMPC_MEASURED) {
            RCLCPP_WARN(get_logger(), "what is measured has %d numbers",
                        GPMPC_MEASURED);
            return;
        }
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
    bool has_reference_ = false;
    rclcpp::Publisher<Numbers>::SharedPtr publisher_;
    rclcpp::Subscription<Numbers>::SharedPtr references_;
    rclcpp::Subscription<Numbers>::SharedPtr measurements_;
};

int main(int count, char **arguments)
{
    rclcpp::init(count, arguments);
    rclcpp::spin(std::make_shared<ControllerNode>());
    rclcpp::shutdown();
    return 0;
}
